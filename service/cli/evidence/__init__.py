"""Commands that read, verify, replay, report and back up the record."""
