"""Evaluates a registration: errors at control spheres, loop closures and the error budget."""
