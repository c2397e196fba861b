"""Camera poses: structure from motion, and the files that hold poses."""
