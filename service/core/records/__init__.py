"""Frozen records: what a run's events say, what people enter, and the list of an import."""
