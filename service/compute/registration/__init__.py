"""From outlines and camera poses to the pose of the scan: identification and registration."""
