"""One file for each arm; each has an entry point of `orthocapture.arms`."""
