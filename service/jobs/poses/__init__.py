"""Kinds of jobs that estimate camera poses from images."""
