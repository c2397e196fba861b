"""Cameras as real bodies were recorded, and what the gphoto driver does with their answers."""
