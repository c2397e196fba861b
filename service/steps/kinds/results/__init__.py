"""Steps that compute and judge a result."""
