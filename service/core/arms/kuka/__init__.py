"""The arms of KUKA, one file each; each has an entry point of `orthocapture.arms`."""
