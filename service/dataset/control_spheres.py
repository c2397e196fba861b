"""The control spheres of a run in the frame of its scan, from the scan that was made before they were taken away."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points, apply
from service.jobs.records import Point


@lru_cache(maxsize=16)
def control_centres(scan: tuple[Point, ...], control: tuple[Point, ...]) -> tuple[Point, ...]:
    """Centres that only the control scan shows, in the frame of the scan."""
    if not scan or not control:
        return ()
    a, b = np.array(scan), np.array(control)
    try:
        found = match_constellations(a, b)
    except ComputeError:
        return ()
    pairs = np.array(found.pairs)
    T_a_b, _ = align_points(a[pairs[:, 0]], b[pairs[:, 1]])
    extra: Array = apply(T_a_b, b[list(found.missing_b)]) if found.missing_b else np.zeros((0, 3))
    return tuple((float(x), float(y), float(z)) for x, y, z in extra)
