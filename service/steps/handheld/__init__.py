"""Captures with the camera in the hand: the parts of the step kind `manual_capture`."""
