"""Pairs of images: correspondences, overlap, difficulty and relative poses from depth and poses."""
