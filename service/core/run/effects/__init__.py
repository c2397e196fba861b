"""What each event does to the state of a run; `fold` applies them."""
