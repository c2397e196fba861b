"""Jobs that estimate camera poses from images, and camera poses from those of the robot."""
