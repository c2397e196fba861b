"""Kinds of jobs that find camera poses from images."""
