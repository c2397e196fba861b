"""The calibration of a run: coverage, residuals, advice, certificate."""
