"""What can be done about a failed step: the recovery policy, the operator's choices, and their words."""
