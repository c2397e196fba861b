"""Mutations of what must not be wrong, each tried against the fast tests that reach it."""
