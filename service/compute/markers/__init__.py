"""Spheres in images: from pixels to outlines on the viewing sphere."""
