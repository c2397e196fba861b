"""Exports requested in the browser, each made by a process of its own."""
