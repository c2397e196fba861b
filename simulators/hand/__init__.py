"""The simulated technician who holds the camera."""
