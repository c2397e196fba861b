"""The posed data set of a finished run, as its record states it."""
