"""Torture: sweeps that search for the next fault, each a `make torture-…` of its own."""
