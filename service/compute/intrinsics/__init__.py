"""The calibration of a camera: its intrinsics, how well they are known, and whether they hold for an image."""
