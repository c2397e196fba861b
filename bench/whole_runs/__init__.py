"""Whole runs on simulated rigs, measured as a user would see them."""
