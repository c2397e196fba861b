"""The ground-truth surface: distances between surfaces, and the fusion of CT and scan."""
