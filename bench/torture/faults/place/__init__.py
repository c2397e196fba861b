"""Where a case happens: its small rig, its files, its disk, and the person beside it."""
