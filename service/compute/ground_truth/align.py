"""Brings a CT mesh into the frame of a scan by the spheres that both show, and says how well they agree."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from service.compute.evaluation.error_budget import compare_shapes
from service.compute.ground_truth.frames import DistanceChange, distance_changes
from service.compute.ground_truth.surface import Surface
from service.compute.surfaces.constellations import match_constellations
from service.compute.surfaces.loop_closure import LoopClosure, close_loop
from service.compute.surfaces.spheres.mesh_spheres import locate_spheres
from service.core.geometry import Array, Transform, apply

TRANSPORT_GATE_M = 3e-4  # largest change of a distance between spheres over the transport


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
        T_scan_ct: from the spheres that did not move.
        covariance: (6, 6) of T_scan_ct, as in `evaluation.closure.Alignment`.
        loop: the spheres one by one.
        distances: their distances before (CT) and after (scan) the transport.
        only_ct: spheres, by their numbers in the CT, that the scan lacks.
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

    @property
    def passed(self) -> bool:
        """Whether no distance changed by more than the gate allows."""
        return self.distances.worst_m <= TRANSPORT_GATE_M


def align(ct: Surface, scan: Surface, radius_m: float) -> Aligned:
    """Find the spheres of a radius in both meshes and register them.

    Raises:
        ComputeError: spheres are lacking, or the two constellations do not agree.
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
