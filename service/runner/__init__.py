"""Drives a run: the loop, the work of a step, and apart from them lease, foot pedal, disk and signatures."""
