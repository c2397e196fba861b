"""Photographs: files, folders, quality and resolution."""
