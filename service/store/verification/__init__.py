"""Whether a data folder is as its own evidence says: chains, signatures, people, index and queue."""
