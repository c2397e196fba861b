"""Contradictions between the inputs of a registration: found, named, and counted in its uncertainty."""
