"""The acquisition service: protocol, state machine, evidence, registration, command line."""
