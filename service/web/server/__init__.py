"""The HTTP server, its listening socket and its limits on connections."""
