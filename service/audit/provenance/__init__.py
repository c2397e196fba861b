"""Where every result came from, as a graph and as its drawing."""
