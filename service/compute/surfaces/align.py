"""Brings a CT mesh into the frame of a scan by the spheres that both show, and says how well they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from service.compute.registration.accuracy import compare_shapes
from service.compute.surfaces.constellations import LoopClosure, close_loop, match_constellations
from service.compute.surfaces.fuse import outside, without_specks
from service.compute.surfaces.mesh_spheres import locate_spheres
from service.compute.surfaces.overlap import SphereRegion
from service.compute.surfaces.surface import Surface
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse, rotation_angle_rad


@dataclass(frozen=True, slots=True)
class TransformLoop:
    """Comparison of T_scan_ct from the spheres with T_scan_ct from the images (CT to cameras, cameras to scan).

    Attributes:
        T_scan_scan: the way around the loop; the identity if both agree.
        rotation_rad: its angle.
        rms_m, worst_m: displacement of the points at which it was judged.
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
        T_scan_ct: the transform by the spheres of both.
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
        worst_m: size of that change.
        rms_m: root mean square of all changes.
    """

    worst: tuple[int, int]
    worst_m: float
    rms_m: float


def distance_changes(before_m: Array, after_m: Array, pairs: Sequence[tuple[int, int]]) -> DistanceChange:
    """Compare all distances between spheres; no registration is needed for it.

    Args:
        before_m: (M, 3) centres in one frame.
        after_m: (N, 3) centres in another.
        pairs: (index before, index after) of the spheres in both.

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


@dataclass(frozen=True, slots=True)
class MeshSpheres:
    """The spheres of a mesh: centres (M, 3), covariances (M, 3, 3), rms (M,) of the surface about them; metres."""

    centres_m: Array
    covariances_m2: Array
    rms_m: Array


@dataclass(frozen=True, slots=True)
class Aligned:
    """A CT in the frame of a scan.

    Attributes:
        T_scan_ct: (4, 4) by the spheres that did not move.
        covariance: (6, 6) covariance of T_scan_ct, as in `evaluation.error_budget.Alignment`.
        loop: the spheres one by one.
        distances: their distances before (CT) and after (scan) the transport.
        only_ct: spheres, by their numbers in the CT, that are missing in the scan.
        taken_away_m: (K, 3) centres of these, in the frame of the scan.
        scan_spheres_m: (M, 3) centres in the scan.
        sigma_ct_m, sigma_scan_m: median rms of the surface of the spheres in each: its noise.
    """

    T_scan_ct: Transform = field(repr=False)
    covariance: Array = field(repr=False)
    loop: LoopClosure
    distances: DistanceChange
    only_ct: tuple[int, ...]
    taken_away_m: Array = field(repr=False)
    scan_spheres_m: Array = field(repr=False)
    sigma_ct_m: float
    sigma_scan_m: float


def align(ct: Surface, scan: Surface, radius_m: float) -> Aligned:
    """Find the spheres of a radius in both meshes and register them.

    Raises:
        ComputeError: spheres are missing, or the two constellations do not agree.
    """
    return align_spheres(_located(ct, radius_m), _located(scan, radius_m))


def align_spheres(ct: MeshSpheres, scan: MeshSpheres) -> Aligned:
    """Register the spheres of a CT with those of a scan. Raises ComputeError if the constellations do not agree."""
    match = match_constellations(scan.centres_m, ct.centres_m)
    loop = close_loop(scan.centres_m, scan.covariances_m2, ct.centres_m, ct.covariances_m2, match)
    i, j = np.array([s.pair for s in loop.spheres if not s.moved]).T
    _, alignment = compare_shapes(scan.centres_m[i], scan.covariances_m2[i], ct.centres_m[j], ct.covariances_m2[j])
    return Aligned(
        T_scan_ct=loop.T_a_b,
        covariance=alignment.covariance,
        loop=loop,
        distances=distance_changes(ct.centres_m, scan.centres_m, [(k, n) for n, k in match.pairs]),
        only_ct=match.missing_b,
        taken_away_m=apply(loop.T_a_b, ct.centres_m[list(match.missing_b)].reshape(-1, 3)),
        scan_spheres_m=scan.centres_m,
        sigma_ct_m=float(np.median(ct.rms_m)),
        sigma_scan_m=float(np.median(scan.rms_m)),
    )


def _located(surface: Surface, radius_m: float) -> MeshSpheres:
    found = locate_spheres(surface.vertices_m, surface.faces, radius_m)
    return MeshSpheres(
        np.array([s.centre_m for s in found]),
        np.array([s.covariance for s in found]),
        np.array([s.rms_m for s in found]),
    )


_MARGIN_M = 0.001  # around a sphere that was taken away: the CT's surface beside it is drawn towards it
# Smaller unconnected parts of the CT are noise, mostly in wood, whose density is near the threshold.
_LEAST_PART_M2 = 5e-5


@dataclass(frozen=True, slots=True)
class CommonPart:
    """A CT without the spheres that were taken away before the scan; `taken` is where they were."""

    ct: Surface = field(repr=False)
    taken: SphereRegion = field(repr=False)


def common_part(ct: Surface, aligned: Aligned, radius_m: float) -> CommonPart:
    """Leave out of a CT, in the scan's frame, the spheres of a radius missing in the scan, and small loose parts."""
    taken = SphereRegion(aligned.taken_away_m, radius_m + _MARGIN_M)
    left = outside(ct, taken)
    del ct
    return CommonPart(without_specks(left, _LEAST_PART_M2), taken)
