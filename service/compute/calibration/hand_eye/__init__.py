"""Hand-eye calibration: closed form, weighted fit, validation and records."""
