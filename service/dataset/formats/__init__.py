"""Export formats: one module each, with a KIND; plug-ins use the entry-point group `orthocapture.exporters`."""
