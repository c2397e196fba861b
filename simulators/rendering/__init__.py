"""What the simulated camera sees of the scene."""
