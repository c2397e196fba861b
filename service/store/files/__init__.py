"""Content-addressed files, what crashes leave of them, and the space that they take."""
