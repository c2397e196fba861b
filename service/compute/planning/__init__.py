"""Where the camera should go next, and how good the data is so far."""
