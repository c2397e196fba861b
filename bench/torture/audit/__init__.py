"""The sweep of the evidence: `make torture-audit`."""
