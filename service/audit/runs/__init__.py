"""Several runs at once: searching, comparing, and figures over time."""
