"""Formats that are COLMAP models."""
