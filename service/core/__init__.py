"""Pure core: records, lifecycle, decisions, recovery, geometry. No input or output here."""
