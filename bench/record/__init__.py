"""Measurements of the record: what an event and a signature cost."""
