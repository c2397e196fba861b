"""The first page and what concerns many runs: start, comparison, history, checklists."""
