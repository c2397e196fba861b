"""What could move an arm without a person's will, and what an arm does when its controller, clock or people err."""
