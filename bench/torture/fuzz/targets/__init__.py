"""What is fuzzed: every parser of the project, by where its input comes from."""
