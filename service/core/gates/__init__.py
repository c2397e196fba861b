"""Measured figures against their limits: verdicts, acceptance by a person, what depends on it, and release."""
