"""What can be done about a failed step: the policy, the choices of a person, and their words."""
