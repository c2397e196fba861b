"""Camera poses from images: structure from motion with COLMAP in child processes, and our own bundle adjustment."""
