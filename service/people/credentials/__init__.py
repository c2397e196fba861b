"""Passwords, PINs, badges, and failed tries."""
