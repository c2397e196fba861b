"""PTP/IP on the camera's side, for any maker: packets and datasets, and the two sockets of a session."""
