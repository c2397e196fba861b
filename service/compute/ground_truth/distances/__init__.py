"""Distances between two surfaces: Chamfer distance, F-score, point to surface, heat maps."""
