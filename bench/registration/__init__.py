"""Accuracy, consistency and cost of the registration."""
