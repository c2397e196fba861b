"""One file for each step kind, with its Params, Measures, Result, execute() and KIND."""
