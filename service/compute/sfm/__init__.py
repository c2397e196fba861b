"""Structure from motion with COLMAP, whose code runs in child processes."""
