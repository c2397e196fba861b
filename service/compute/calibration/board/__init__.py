"""Calibration boards and their corners in images."""
