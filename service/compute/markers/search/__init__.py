"""Search for spheres in many images: a few are searched whole, the others only where spheres are predicted."""
