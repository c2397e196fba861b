"""The report of a run: what it says, its drawings, and the files it is written to."""
