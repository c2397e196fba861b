"""Spheres in many images: a few are searched whole, in the others only where they are predicted."""
