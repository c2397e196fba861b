"""The poses of further cameras from the spheres they see: the robust mean over their images, with covariances."""
