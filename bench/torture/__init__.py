"""Sweeps for faults that no single test looks for, each with its own `make torture-…` (docs/howto/torture.md)."""
