"""The arms of Universal Robots, one file each; each has an entry point of `orthocapture.arms`."""
