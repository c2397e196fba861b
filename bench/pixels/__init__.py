"""Measurements of what belongs to the pixels of an image."""
