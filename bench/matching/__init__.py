"""Benchmarks of feature matching."""
