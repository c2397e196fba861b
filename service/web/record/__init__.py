"""What several pages read from a run: its images, spheres, planned poses and board images."""
