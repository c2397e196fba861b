"""The crash sweep: `make torture-crash`."""
