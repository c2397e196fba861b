"""Reads text files with line numbers for every problem, and has the texts that people read."""
