"""Drives a run: the loop, the execution of a step, the leave to move, the foot pedal, and the upkeep besides."""
