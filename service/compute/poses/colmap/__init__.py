"""COLMAP: its model files, its conventions, and the child process in which it runs."""
