"""Commands that start and drive runs."""
