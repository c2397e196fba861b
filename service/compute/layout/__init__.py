"""Checks whether placed spheres can be distinguished, and which one to move if not."""
