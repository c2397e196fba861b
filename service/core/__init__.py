"""Pure core: records, lifecycle, decisions, recovery, geometry, and checks of the files that come in."""
