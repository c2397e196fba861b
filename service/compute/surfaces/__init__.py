"""Surfaces of scans and CT volumes: their spheres, their fusion to the ground truth, and distances between them."""
