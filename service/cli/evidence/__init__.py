"""The commands that read, verify, replay, report and keep what was recorded."""
