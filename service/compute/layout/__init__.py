"""Whether placed spheres can be told apart, and which one to move if not."""
