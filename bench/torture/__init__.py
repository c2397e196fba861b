"""Sweeps for faults that no single test looks for, each a `make torture-…` of its own (docs/howto/torture.md)."""
