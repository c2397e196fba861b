"""Dense stereo on a processor: rectified pairs of posed images, and their depth maps fused to a mesh."""
