"""Fuzzing of every parser in the project: no crash, no hang, bounded memory, always a typed error."""
