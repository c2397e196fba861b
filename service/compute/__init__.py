"""Pure numerics on arrays and frozen dataclasses: detection, calibration, registration, evaluation."""
