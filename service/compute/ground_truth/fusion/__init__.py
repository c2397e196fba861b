"""Fusion of CT and scan into one ground-truth mesh."""
