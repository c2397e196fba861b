"""Live capture by the robot: viewpoints, last image, plan and pictures."""
