"""Computes what belongs to each pixel of a posed image: rays, depth, normals, masks, undistorted images and crops."""
