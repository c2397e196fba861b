"""Mesh and point cloud files, which scanners and CT suites export."""
