"""The data set of a run: its views, depth, coverage, and how its surfaces agree."""
