"""Kinds of jobs on images of the calibration board."""
