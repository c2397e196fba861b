"""Passwords, PINs and badges, and failed tries."""
