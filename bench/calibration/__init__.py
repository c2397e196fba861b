"""Calibration of camera and hand-eye against ground truth."""
