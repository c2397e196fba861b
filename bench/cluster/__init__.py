"""Measurements of what is parallel inside a job."""
