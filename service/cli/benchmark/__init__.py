"""`orthocapture benchmark`: methods compared on an exported data set."""
