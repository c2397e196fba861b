"""Brings a CT mesh into the frame of a scan by the spheres that both show, and says how well they agree."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from service.compute.evaluation.closure import compare_shapes
from service.compute.ground_truth.frames import DistanceChange, distance_changes
from service.compute.ground_truth.surface import Surface
from service.compute.surfaces.constellations import match_constellations
from service.compute.surfaces.loop_closure import LoopClosure, close_loop
from service.compute.surfaces.spheres.mesh_spheres import MeshSphere, locate_spheres
from service.core.geometry import Array, Transform

TRANSPORT_GATE_M = 3e-4  # largest change of a distance between spheres over the transport


@dataclass(frozen=True, slots=True)
class Aligned:
    """A CT in the frame of a scan.

    Attributes:
        T_scan_ct: from the spheres that did not move.
        covariance: (6, 6) of T_scan_ct, as in `evaluation.closure.Alignment`.
        loop: the spheres one by one.
        distances: their distances before (CT) and after (scan) the transport.
        scan_spheres_m: (M, 3) centres in the scan.
        sigma_ct_m, sigma_scan_m: median rms of the surface of the spheres in each: its noise.
    """

    T_scan_ct: Transform = field(repr=False)
    covariance: Array = field(repr=False)
    loop: LoopClosure
    distances: DistanceChange
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
    in_ct = locate_spheres(ct.vertices_m, ct.faces, radius_m)
    in_scan = locate_spheres(scan.vertices_m, scan.faces, radius_m)
    (a, Ca), (b, Cb) = _arrays(in_scan), _arrays(in_ct)
    match = match_constellations(a, b)
    loop = close_loop(a, Ca, b, Cb, match)
    staying = np.array([s.pair for s in loop.spheres if not s.moved])
    i, j = staying.T
    _, alignment = compare_shapes(a[i], Ca[i], b[j], Cb[j])
    return Aligned(
        T_scan_ct=loop.T_a_b,
        covariance=alignment.covariance,
        loop=loop,
        distances=distance_changes(b, a, [(k, n) for n, k in match.pairs]),
        scan_spheres_m=a,
        sigma_ct_m=float(np.median([s.rms_m for s in in_ct])),
        sigma_scan_m=float(np.median([s.rms_m for s in in_scan])),
    )


def _arrays(spheres: tuple[MeshSphere, ...]) -> tuple[Array, Array]:
    return np.array([s.centre_m for s in spheres]), np.array([s.covariance for s in spheres])
