"""The lab procedures that come with orthocapture, one YAML file each; a package so that a wheel holds them."""
