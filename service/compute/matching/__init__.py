"""Feature matching: ground truth for pairs of images, and the scores of methods on it."""
