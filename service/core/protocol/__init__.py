"""The lab procedure: the models of a protocol file, and the rules that go beyond types."""
