"""Our own programs of reconstruction, each run as a process that sees only an exported folder."""
