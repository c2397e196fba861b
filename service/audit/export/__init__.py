"""Exports asked for on the screen, each made by a process of its own."""
