"""Step kinds: one file for each, with its Params, Measures, Result, execute() and KIND, or those of its parts."""
