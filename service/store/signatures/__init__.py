"""Signed checkpoints of the chains: keys, time stamps, and the log of signatures outside the database."""
