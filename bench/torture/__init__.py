"""Sweeps that search for faults no single test looks for, each a `make torture-…` of its own (docs/torture.md)."""
