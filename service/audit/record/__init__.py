"""Read-only access to the runs, events and files of the evidence."""
