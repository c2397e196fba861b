"""One file a step kind: its Params, its Result, its execute()."""
