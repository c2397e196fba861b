"""Spheres and surfaces in scans and CT volumes."""
