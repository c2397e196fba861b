"""Jobs while images are being taken, by the robot or by hand."""
