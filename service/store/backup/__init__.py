"""Copies of a data folder, and a data folder from a copy."""
