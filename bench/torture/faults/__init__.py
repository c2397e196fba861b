"""The fault matrix, `make torture-faults`: every kind of message of every device, spoilt in every way."""
