"""Messages of ROS 2 without ROS: their encoding (CDR), their definitions, and recordings in MCAP files."""
