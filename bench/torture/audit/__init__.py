"""The evidence sweep: `make torture-audit`."""
