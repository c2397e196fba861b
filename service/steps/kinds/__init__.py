"""One file a step kind: its Params, its Result, its execute(). A module with a KIND is a step kind."""
