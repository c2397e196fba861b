"""Photograph files, of whatever camera: one file, and a folder of them."""
