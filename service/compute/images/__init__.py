"""Photographs: reading them from files and folders, and developing raw ones."""
