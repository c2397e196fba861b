"""Hybrid camera poses: tracks, robot poses and measured spheres in one bundle adjustment."""
