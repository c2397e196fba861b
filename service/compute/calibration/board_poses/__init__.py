"""Where to put the camera for a calibration: candidates, their information, and the choice."""
