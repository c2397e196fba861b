"""Numerics on arrays, and the images, meshes and poses they begin with: calibration, registration, evaluation."""
