"""Detects spheres that moved between two measurements, from differences and their uncertainties."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from service.compute.descent import gauss_newton
from service.compute.surfaces.constellations import ConstellationMatch
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, place_jacobian, transform

SYSTEMATIC_SIGMA_M = 2.0e-5  # per coordinate: difference of two instruments beyond their noise (scale, temperature)
MOVED_PROBABILITY = 1.0e-3  # of a false alarm: some sphere is reported as moved though none did
_LEAST = 4  # unmoved spheres needed as the reference for the others


@dataclass(frozen=True, slots=True)
class SphereDifference:
    """One sphere in both measurements, in a common frame defined by the spheres that did not move.

    Attributes:
        pair: (index in a, index in b).
        difference_m: (3,) position in b minus position in a, in frame a.
        sigma_m: standard deviation of the difference along its direction, including the registration's.
        z: Mahalanobis length of the difference.
        moved: whether the sphere counts as moved.
    """

    pair: tuple[int, int]
    difference_m: Array
    sigma_m: float
    z: float
    moved: bool


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """Comparison of two measurements of one scene.

    Attributes:
        T_a_b: rigid, from the spheres that did not move, weighted by the covariances.
        spheres: in the order of the match's pairs.
        chi2_per_dof: of the spheres that did not move; near 1 if the stated uncertainties are right.
        rms_m: of the differences of the spheres that did not move.
        sigma_rms_m: predicted rms from the stated uncertainties.
        scale: lengths in b over lengths in a, by all spheres: one of two instruments may be calibrated wrongly.
        scale_sigma: its standard deviation.
    """

    T_a_b: Transform
    spheres: tuple[SphereDifference, ...]
    chi2_per_dof: float
    rms_m: float
    sigma_rms_m: float
    scale: float
    scale_sigma: float

    @property
    def moved(self) -> tuple[SphereDifference, ...]:
        """The spheres that moved, the most significant first."""
        return tuple(sorted((s for s in self.spheres if s.moved), key=lambda s: -s.z))


def close_loop(
    a: Array,
    covariances_a: Array,
    b: Array,
    covariances_b: Array,
    match: ConstellationMatch,
    systematic_sigma_m: float = SYSTEMATIC_SIGMA_M,
) -> LoopClosure:
    """Compare the matched spheres of two measurements and name those that moved.

    Each sphere is predicted from the others. The one farthest from its prediction is set aside if chance does not
    explain it, and the rest are judged again.

    Args:
        a: (M, 3) centres, metres.
        covariances_a: (M, 3, 3), m².
        b: (N, 3) centres in another frame, metres.
        covariances_b: (N, 3, 3), m².
        match: correspondence of the spheres.
        systematic_sigma_m: added to every coordinate of a difference.

    Raises:
        ComputeError: fewer than four common spheres.
    """
    if len(match.pairs) < _LEAST:
        raise ComputeError(f"{len(match.pairs)} spheres in common do not close a loop", remedy="Scan all spheres")
    rows, columns = (np.array(side) for side in zip(*match.pairs, strict=True))
    pa, pb = a[rows], b[columns]
    R = match.T_a_b[:3, :3]
    C = covariances_a[rows] + R @ covariances_b[columns] @ R.T + systematic_sigma_m**2 * np.eye(3)
    staying = np.ones(len(pa), dtype=np.bool_)
    limit = MOVED_PROBABILITY / len(pa)
    while staying.sum() > _LEAST:
        z2 = np.array([_against_others(pa, pb, C, staying, int(i), match.T_a_b)[1] for i in np.flatnonzero(staying)])
        worst = int(z2.argmax())
        if chdtrc(3, float(z2[worst])) >= limit:
            break
        staying[np.flatnonzero(staying)[worst]] = False
    T, _ = _weighted(pa[staying], pb[staying], C[staying], match.T_a_b)
    spheres: list[SphereDifference] = []
    for i, pair in enumerate(match.pairs):
        difference, z2, sigma = _against_others(pa, pb, C, staying, i, T)
        spheres.append(SphereDifference(pair, difference, sigma, float(np.sqrt(z2)), moved=not bool(staying[i])))
    d = apply(T, pb[staying]) - pa[staying]
    dof = 3 * int(staying.sum()) - 6
    statistic = float(np.einsum("ni,nij,nj->", d, np.linalg.inv(C[staying]), d))
    expected = float(np.trace(C[staying], axis1=1, axis2=2).sum()) * dof / (3 * staying.sum())
    return LoopClosure(
        T_a_b=T,
        spheres=tuple(spheres),
        chi2_per_dof=statistic / dof,
        rms_m=float(np.sqrt(np.mean(np.sum(d**2, axis=1)))),
        sigma_rms_m=float(np.sqrt(expected / staying.sum())),
        scale=align_points(pb, pa, with_scale=True)[1],
        scale_sigma=float(np.sqrt(np.trace(C, axis1=1, axis2=2).mean() / 3 / np.sum((pa - pa.mean(axis=0)) ** 2))),
    )


def _against_others(
    a: Array, b: Array, C: Array, staying: NDArray[np.bool_], i: int, start: Transform
) -> tuple[Array, float, float]:
    """Difference (3,) of sphere i from its prediction by the others, squared Mahalanobis length, and sigma."""
    others = staying.copy()
    others[i] = False
    T, covariance = _weighted(a[others], b[others], C[others], start)
    predicted = apply(T, b[i])
    J = place_jacobian(predicted[None])[0]
    S = C[i] + J @ covariance @ J.T
    d = predicted - a[i]
    length = float(np.linalg.norm(d))
    along = d / length if length > 0 else np.array([1.0, 0.0, 0.0])
    return d, float(d @ np.linalg.solve(S, d)), float(np.sqrt(along @ S @ along))


def _weighted(a: Array, b: Array, C: Array, start: Transform) -> tuple[Transform, Array]:
    """Rigid T_a_b by generalised least squares, and its covariance (6, 6) of (t, w) at a's origin, outer frame."""
    W = np.linalg.inv(C)

    def equations(T: Transform) -> tuple[Array, Array]:
        points = apply(T, b)
        J = place_jacobian(points)
        JW = np.einsum("nki,nkl->nil", J, W)
        return np.einsum("nil,nlj->ij", JW, J), np.einsum("nil,nl->i", JW, a - points)

    T = gauss_newton(
        start,
        lambda T: np.asarray(np.linalg.solve(*equations(T)), dtype=np.float64),
        lambda T, step: transform(Rotation.from_rotvec(step[3:]), step[:3]) @ T,
        most=8,
        settled=1e-12,
    )
    return T, np.asarray(np.linalg.inv(equations(T)[0]), dtype=np.float64)
