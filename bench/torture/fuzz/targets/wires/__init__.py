"""Fuzz targets on wires: messages of devices and of ROS 2, and the peers that speak them."""
