"""The simulated scene and its true geometry: specimen, spheres, table, arms and lens."""
