"""Hand-eye calibration: the camera in the flange frame, or the board in it, from images and robot poses."""
