"""Sweeps for faults that no single test looks for: crashes, power loss, bad input, forged evidence."""
