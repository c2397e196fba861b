"""Frozen records: the events of a run, what people enter, and the file list of an import."""
