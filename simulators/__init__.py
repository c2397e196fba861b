"""Simulators: the other end of each wire, in processes of their own; they import neither drivers nor service."""
