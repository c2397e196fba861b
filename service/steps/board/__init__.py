"""Images of the calibration board: planned, taken, looked at, and taken again where they fall short."""
