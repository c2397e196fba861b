"""Drawings and pictures of a report."""
