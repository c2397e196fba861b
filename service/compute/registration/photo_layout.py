"""Places of spheres from single photographs: each cone gives a distance, and photographs are merged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.compute.markers.records import SphereOutline
from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, apply

LEAST_SPHERES = 4
_TOLERANCE_M = 0.012  # between two photographs: depths err by some millimetres


def places_from_outlines(
    outlines: Sequence[SphereOutline], radius_m: float, focal_sigma: float = 0.02
) -> tuple[Array, Array]:
    """Centres (N, 3) in the camera frame and their covariances (N, 3, 3), m², from outlines of known radius.

    Args:
        outlines: of one image.
        radius_m: of the spheres.
        focal_sigma: relative standard deviation of a focal length that was not calibrated; it scales all depths
            alike, so that it does not enter the covariances but for the part that differs between the spheres.
    """
    centres: list[Array] = []
    covariances: list[Array] = []
    for outline in outlines:
        half = outline.cone.half_angle_rad
        distance = radius_m / np.sin(half)
        frame = outline.cone.frame()
        # The columns of `frame`: two across the axis, and the axis.
        J = np.stack(
            [frame[:, 0] * distance, frame[:, 1] * distance, -outline.cone.axis * distance / np.tan(half)], 1
        )
        centres.append(outline.cone.axis * distance)
        covariances.append(J @ outline.cone_covariance @ J.T)
    if not centres:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    places, spread = np.array(centres), np.array(covariances)
    depth = places @ places.mean(axis=0) / np.linalg.norm(places.mean(axis=0))
    tilt = focal_sigma * (depth - depth.mean())
    along = places / np.linalg.norm(places, axis=1, keepdims=True)
    return places, spread + np.einsum("n,ni,nj->nij", tilt**2, along, along)


def merge_places(photographs: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, int]:
    """One layout from several photographs: centres (N, 3), covariances, and how many photographs went into it.

    The photograph with most spheres leads; the others join as far as their spheres agree with it, and add those
    that it does not show.

    Raises:
        ComputeError: no photograph shows four spheres.
    """
    ranked = sorted((p for p in photographs if len(p[0]) >= LEAST_SPHERES), key=lambda p: -len(p[0]))
    if not ranked:
        most = max((len(p[0]) for p in photographs), default=0)
        raise ComputeError(
            f"no photograph shows more than {most} spheres, {LEAST_SPHERES} are needed",
            remedy="photograph all spheres from above, sharp and from less than a metre",
        )
    centres, covariances = ranked[0]
    used = 1
    for other, spread in ranked[1:]:
        try:
            match = match_constellations(centres, other, _TOLERANCE_M)
        except ComputeError:
            continue  # too few in common, or ambiguous: that is for the layout check to say
        used += 1
        R = match.T_a_b[:3, :3]
        moved, turned = apply(match.T_a_b, other), R @ spread @ R.T
        for i, j in match.pairs:
            A, B = np.linalg.inv(covariances[i]), np.linalg.inv(turned[j])
            both = np.linalg.inv(A + B)
            centres = centres.copy()
            covariances = covariances.copy()
            centres[i] = both @ (A @ centres[i] + B @ moved[j])
            covariances[i] = both
        new = list(match.missing_b)
        centres = np.concatenate([centres, moved[new]])
        covariances = np.concatenate([covariances, turned[new]])
    return centres, covariances, used
