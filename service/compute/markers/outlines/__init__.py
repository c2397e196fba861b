"""From edge pixels to a sub-pixel outline of one sphere, with its covariance."""
