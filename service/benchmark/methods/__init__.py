"""One file for each method of reconstruction: the format it reads, its commands, and where its mesh comes from."""
