"""Recorded computations done again and compared with the record."""
