"""Kinds of jobs while images are being taken."""
