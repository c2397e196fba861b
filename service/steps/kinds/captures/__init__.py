"""Steps that take images or the camera's calibration at the table."""
