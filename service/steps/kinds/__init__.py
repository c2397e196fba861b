"""Step kinds: one file for each, with its Params, Measures, Result, execute() and KIND, in any folder here."""
