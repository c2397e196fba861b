"""The registrations of a run: which there are, which one is the run's own, and which arrived late."""
