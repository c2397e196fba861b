"""The lab procedure: the models of a protocol file, and what it must obey beyond them."""
