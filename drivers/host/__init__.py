"""A driver in a process of its own, and what keeps it there: the parent's side, the child's, heartbeat and lock."""
