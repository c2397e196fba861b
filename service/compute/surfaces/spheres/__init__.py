"""Spheres of known radius in meshes and point clouds."""
