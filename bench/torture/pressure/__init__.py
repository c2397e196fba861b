"""Whole small runs on a machine without processor time, without memory, and with drivers that are killed."""
