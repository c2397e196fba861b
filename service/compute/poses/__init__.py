"""Files that hold camera poses: of robots, recordings of ROS 2, COLMAP and others, with the cameras beside them."""
