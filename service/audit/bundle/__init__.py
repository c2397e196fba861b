"""The evidence of a run as one file for people outside."""
