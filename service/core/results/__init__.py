"""The registrations of a run: which it has, which is its own, and which came late."""
