"""What the tests' processes cost: hundreds of them are started by one run of the tests."""
