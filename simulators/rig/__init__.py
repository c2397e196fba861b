"""The simulated rig: its processes, and the world that they share."""
