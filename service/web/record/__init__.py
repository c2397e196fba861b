"""What several pages read of a run: its images, spheres, planned poses and board images."""
