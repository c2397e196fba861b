"""The sweep of crashes: `make torture-crash`."""
