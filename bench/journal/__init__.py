"""The journal measured, and every file of a data folder altered at every moment."""
