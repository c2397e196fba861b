"""Formats of radiance fields and neural surfaces."""
