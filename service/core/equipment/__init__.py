"""Whether clocks, camera bodies and disk space suit a run, judged from the record."""
