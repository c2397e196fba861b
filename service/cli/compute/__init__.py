"""The commands that compute from files, without a run."""
