"""Many runs at once: found, compared, and their figures over time."""
