"""Camera intrinsics and hand-eye from images of a calibration board."""
