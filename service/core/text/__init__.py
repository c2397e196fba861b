"""Reading text files with line numbers for every problem, and the words that people read."""
