"""Evidence: the hash-chained events, content-addressed artefacts and jobs of every run."""
