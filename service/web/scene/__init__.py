"""The scene of a run in 3D and as tables."""
