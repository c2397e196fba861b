"""The commands that make and drive a run."""
