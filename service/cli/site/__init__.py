"""Commands of a site: its rig, pages, workers, protocols and plans."""
