"""Numerics on arrays and frozen dataclasses: detection, calibration, registration, evaluation."""
