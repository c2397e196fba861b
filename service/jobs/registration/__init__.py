"""Kinds of jobs that bring images and scan into one frame, and judge how well."""
