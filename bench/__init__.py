"""Measurements: each file is a script that anyone can run."""
