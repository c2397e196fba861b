"""A simulated hand scanner and the files that its software exports."""
