"""Calibration of a camera, its place on the arm and the arm itself, from images of a board."""
