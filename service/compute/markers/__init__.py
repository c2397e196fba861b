"""Detection of spheres in images: from pixels to outlines as cones of rays."""
