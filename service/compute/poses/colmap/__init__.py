"""COLMAP: its model files, its convention, and the child process in which it works."""
