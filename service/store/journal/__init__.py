"""The journal: every committed change of the record, written to a file of its own before it counts."""
