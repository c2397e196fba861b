"""Jobs that find camera poses from images, and the poses of the robot."""
