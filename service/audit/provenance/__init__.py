"""Provenance: where every result came from, as a graph and as a drawing."""
