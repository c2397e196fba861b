"""Soak tests: growth over an hour, 10,000 viewpoints, many processes at once, and speed (docs/howto/soak.md)."""
