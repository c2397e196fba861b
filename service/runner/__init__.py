"""Drives a run: the loop, the execution of a step, and separately lease, foot pedal, disk, clocks and signatures."""
