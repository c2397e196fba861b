"""Spheres in images and in meshes: accuracy, recall and speed of their detection."""
