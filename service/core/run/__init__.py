"""A run as a state machine: its state, the fold of its events, the next decision, and operator actions."""
