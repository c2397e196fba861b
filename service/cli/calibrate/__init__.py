"""`orthocapture calibrate`: intrinsics and hand-eye calibration from images of a board."""
