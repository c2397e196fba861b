"""Bad input for every parser of the project: no crash, no hang, no memory beyond a bound, always a typed error."""
