"""Computes the pose of the scan from outlines and camera poses: identification and registration."""
