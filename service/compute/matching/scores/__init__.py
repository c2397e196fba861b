"""Scores of feature matching: distances of matches from the truth, and errors of the poses that they give."""
