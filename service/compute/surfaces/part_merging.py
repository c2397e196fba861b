"""Merges scans that each show a part of the scene: their poses from the spheres that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.compute.surfaces.constellations import match_constellations
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply

_ROUNDS = 30  # of the common adjustment; it converges in a few


@dataclass(frozen=True, slots=True)
class MergedParts:
    """The poses of parts in the frame of the first one.

    Attributes:
        T_first_part: (4, 4) of each part, metres; the identity for the first.
        spheres: number of different spheres.
        shared: number of spheres that two parts or more show.
        residuals_m: distance of every sphere that is shared, in every part, from its mean over the parts.
    """

    T_first_part: tuple[Transform, ...]
    spheres: int
    shared: int
    residuals_m: Array

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))


def merge_parts(parts_m: Sequence[Array]) -> MergedParts:
    """Place parts by their spheres, and adjust all poses together.

    Args:
        parts_m: sphere centres (N, 3) of each part in its own frame, metres.

    Raises:
        ComputeError: a part shares fewer than four spheres with the others, all of them in a plane, or is mirrored;
            names the part.
    """
    poses: dict[int, Transform] = {0: np.eye(4)}
    members: list[dict[int, int]] = [{0: index} for index in range(len(parts_m[0]))]  # of a sphere: part → its index
    while len(poses) < len(parts_m):
        part, T, pairs = _next(parts_m, poses, members)
        poses[part] = T
        known = {index: sphere for sphere, index in pairs}
        for index in range(len(parts_m[part])):
            if index in known:
                members[known[index]][part] = index
            else:
                members.append({part: index})
    shared = [sphere for sphere in members if len(sphere) > 1]
    for _ in range(_ROUNDS):
        means = [_mean(sphere, parts_m, poses) for sphere in shared]
        for part in range(1, len(parts_m)):
            rows = [(mean, sphere[part]) for mean, sphere in zip(means, shared, strict=True) if part in sphere]
            target, own = np.array([mean for mean, _ in rows]), parts_m[part][[index for _, index in rows]]
            poses[part], _ = align_points(target, own)
    residuals = [
        np.linalg.norm(apply(poses[part], parts_m[part][index]) - _mean(sphere, parts_m, poses))
        for sphere in shared
        for part, index in sphere.items()
    ]
    ordered = tuple(poses[part] for part in range(len(parts_m)))
    return MergedParts(ordered, len(members), len(shared), np.array(residuals, dtype=np.float64))


def _next(
    parts_m: Sequence[Array], poses: dict[int, Transform], members: list[dict[int, int]]
) -> tuple[int, Transform, tuple[tuple[int, int], ...]]:
    """The part that shares most spheres with those that are placed: its pose, and the pairs (sphere, own index)."""
    placed = np.array([_mean(sphere, parts_m, poses) for sphere in members])
    found: list[tuple[int, int, Transform, tuple[tuple[int, int], ...]]] = []
    failed: dict[int, ComputeError] = {}
    for part in range(len(parts_m)):
        if part in poses:
            continue
        try:
            match = match_constellations(placed, parts_m[part])
        except ComputeError as error:
            failed[part] = error
            continue
        found.append((len(match.pairs), -part, match.T_a_b, match.pairs))
    if not found:
        part, error = next(iter(failed.items()))
        raise ComputeError(
            f"part {part + 1} of the scan cannot be placed: {error.what}",
            remedy="Scan every part so that it shows four spheres of another part, not all in a plane",
        ) from error
    _, minus, T, pairs = max(found, key=lambda one: one[:2])
    return -minus, T, pairs


def _mean(sphere: dict[int, int], parts_m: Sequence[Array], poses: dict[int, Transform]) -> Array:
    """Mean position (3,) of a sphere over the parts that show it, in the frame of the first."""
    return np.mean([apply(poses[part], parts_m[part][index]) for part, index in sphere.items()], axis=0)
