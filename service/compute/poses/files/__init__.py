"""Files of camera poses and of what goes with them."""
