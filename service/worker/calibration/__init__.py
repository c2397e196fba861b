"""Jobs on images of the calibration board."""
