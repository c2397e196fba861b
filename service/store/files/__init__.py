"""Content-addressed files, leftovers of crashes, and used disk space."""
