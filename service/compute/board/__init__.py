"""Calibration boards: their points in images, and the poses from which they are photographed."""
