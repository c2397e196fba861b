"""Simulated devices, each the other end of a real wire in its own process.

They import neither drivers nor service.
"""
