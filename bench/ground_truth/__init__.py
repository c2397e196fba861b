"""Ground truth: speed of the Chamfer distance, accuracy of the fusion."""
