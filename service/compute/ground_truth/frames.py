"""Checks that CT, scan and cameras are in one frame: the loop of their transforms, and sphere distances over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse, rotation_angle_rad


@dataclass(frozen=True, slots=True)
class TransformLoop:
    """Comparison of T_scan_ct from the spheres with T_scan_ct from the images (CT to cameras, cameras to scan).

    Attributes:
        T_scan_scan: the way around the loop; the identity if both agree.
        rotation_rad: of it.
        rms_m, worst_m: displacement of the points that it was judged at.
    """

    T_scan_scan: Transform = field(repr=False)
    rotation_rad: float
    rms_m: float
    worst_m: float


def close_transforms(
    T_scan_ct: Transform, T_world_scan: Transform, T_world_ct: Transform, points_scan_m: Array
) -> TransformLoop:
    """Go from the scan to the CT by the spheres, and back by the cameras.

    Args:
        T_scan_ct: from sphere to sphere.
        T_world_scan, T_world_ct: image-based registrations of the two meshes.
        points_scan_m: (N, 3) where the difference matters, such as the spheres or the specimen.
    """
    around = inverse(T_world_scan) @ T_world_ct @ inverse(T_scan_ct)
    length = np.linalg.norm(apply(around, points_scan_m) - points_scan_m, axis=1)
    return TransformLoop(around, rotation_angle_rad(around), float(np.sqrt(np.mean(length**2))), float(length.max()))


@dataclass(frozen=True, slots=True)
class DistanceChange:
    """Distances between spheres before and after the transport.

    Attributes:
        worst: the two spheres whose distance changed most.
        worst_m: that change, without its sign: what the gate judges.
        rms_m: of all changes.
    """

    worst: tuple[int, int]
    worst_m: float
    rms_m: float


def distance_changes(before_m: Array, after_m: Array, pairs: Sequence[tuple[int, int]]) -> DistanceChange:
    """Compare all distances between spheres; no registration is needed for it.

    Args:
        before_m: (M, 3) centres in one frame.
        after_m: (N, 3) centres in another.
        pairs: (index before, index after) of the spheres that both hold.

    Raises:
        ComputeError: fewer than two common spheres.
    """
    if len(pairs) < 2:
        raise ComputeError(f"{len(pairs)} common spheres have no distance", remedy="Scan all spheres")
    a, b = (np.array([centres[pair[k]] for pair in pairs]) for k, centres in enumerate((before_m, after_m)))
    both = tuple(combinations(range(len(pairs)), 2))
    first, second = np.array(both).T
    change = np.linalg.norm(b[first] - b[second], axis=1) - np.linalg.norm(a[first] - a[second], axis=1)
    worst = int(np.abs(change).argmax())
    return DistanceChange(both[worst], float(np.abs(change[worst])), float(np.sqrt(np.mean(change**2))))
