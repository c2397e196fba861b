"""Hybrid poses: images, robot and spheres in one bundle adjustment."""
