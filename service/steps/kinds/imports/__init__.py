"""Steps that bring in what other devices made: CT, scan, photographs."""
