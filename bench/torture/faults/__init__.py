"""The fault matrix: every kind of message of every device spoilt in every way: `make torture-faults`."""
