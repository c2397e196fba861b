"""Capture by hand: the way to go, the last image and the hemisphere."""
