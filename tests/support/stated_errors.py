"""What a registration and an evaluation state about their own errors, summed up for tests and benches."""

from __future__ import annotations

import numpy as np

from service.compute.registration.accuracy import Alignment, Evaluation
from service.compute.registration.result import RegistrationResult
from service.core.geometry import Array


def sigma_components_m(registration: RegistrationResult, point_scan_m: Array) -> dict[str, float]:
    """Contribution (m, 3D) of each source to the registration's sigma at a point (3,) of the scan."""
    sigmas: dict[str, float] = {}
    for name, part in registration.components.items():
        placed = Alignment(registration.T_world_scan, part[:6, :6])
        sigmas[name] = float(np.sqrt(np.trace(placed.covariance_at_m2(point_scan_m[None])[0])))
    return sigmas


def normalised_rms(evaluation: Evaluation) -> float | None:
    """Rms of the normalised errors: near 1 if the stated covariances are right; None if there are none."""
    values = [error.normalised for error in evaluation.errors if error.normalised is not None]
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
