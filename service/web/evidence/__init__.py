"""The evidence behind a run, to be read by auditors: events, files, provenance, the record of the site."""
