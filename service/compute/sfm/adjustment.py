"""Solves a bundle adjustment robustly, with variance components and the covariance of its poses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from service.compute.descent import Damping, levenberg_marquardt
from service.compute.sfm.bundle import (
    AdjustmentData,
    BundleState,
    Normal,
    Rows,
    Sigmas,
    linearise,
    moved,
    normal_equations,
)
from service.core.errors import ComputeError
from service.core.geometry import Array

_SETTLED = 0.2  # change of the cost (a chi square of all residuals) below which an adjustment has converged
_NEARLY = 5.0  # the same while the variances are still being estimated
_MOST_STEPS = 40
_DAMPING = Damping(1e-6, down=10, up=30, least=1e-9)
_LEAST = Sigmas(track_px=0.02, sphere=0.3, robot_m=1e-5, robot_rad=1e-5)  # lower bounds of the estimates


@dataclass(frozen=True, slots=True)
class BundleSolution:
    """The adjusted state.

    Attributes:
        state: the adjusted cameras, points, bases and camera model.
        sigmas: the estimated sigmas of the components.
        weights: robust weight of each measurement, by component.
        covariance: (n, n) covariance of the frame parameters, points eliminated.
        chi2: reduced chi square of each component, with robust weights and its own redundancy.
        steps: number of linearisations.
    """

    state: BundleState
    sigmas: Sigmas
    weights: dict[str, Array]
    covariance: Array
    chi2: dict[str, float]
    steps: int


def solve(state: BundleState, data: AdjustmentData, sigmas: Sigmas, *, rounds: int = 3) -> BundleSolution:
    """Adjust by Levenberg–Marquardt with Cauchy weights; the components' variances are estimated between rounds.

    The variances are Förstner's estimates: each component's weighted sum of squares over its redundancy (Koch,
    Parameter Estimation and Hypothesis Testing in Linear Models, 3.6).

    Raises:
        ComputeError: no convergence, or the data leave something undetermined.
    """
    steps = 0
    sigmas = first_guess(state, data, sigmas)
    chi2: dict[str, float] = {}
    redundancy: dict[str, float] = {}
    weights: dict[str, Array] = {}
    covariance = np.empty((0, 0))
    for turn in range(rounds):
        state, rows, used = _descend(state, data, sigmas, _SETTLED if turn + 1 == rounds else _NEARLY)
        steps += used
        weights = _weights(rows)
        weighted = {name: r.weighted(weights[name]) for name, r in rows.items()}
        normal = normal_equations(list(weighted.values()))
        covariance = inverse_information(normal.schur)
        redundancy = _redundancy(weighted, normal, covariance)
        chi2 = {
            name: float(np.sum(r.squares))
            / max(redundancy[name], 1e-3)
            / (EXPECTED[name].square if name in EXPECTED else 1)
            for name, r in weighted.items()
        }
        if turn + 1 < rounds:
            sigmas = _estimated(sigmas, chi2, redundancy)
        else:
            covariance = stated_covariance(weighted, len(normal.schur))
    return BundleSolution(state, sigmas, weights, covariance, chi2, steps)


def first_guess(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> Sigmas:
    """Set the tracks' sigma by the median of their residuals, so that robust weights work from the start."""
    squares = linearise(state, dataclasses.replace(data, sightings=None, robot=None, lens_covariance=None), sigmas)[
        "tracks"
    ].squares
    return dataclasses.replace(
        sigmas,
        track_px=max(_LEAST.track_px, sigmas.track_px * math.sqrt(float(np.median(squares)) / (2 * math.log(2)))),
    )


@dataclass(frozen=True, slots=True)
class _Linearised:
    state: BundleState
    rows: dict[str, Rows]
    cost: float


def _descend(
    state: BundleState, data: AdjustmentData, sigmas: Sigmas, settled: float
) -> tuple[BundleState, dict[str, Rows], int]:
    def at(there: BundleState) -> _Linearised:
        rows = linearise(there, data, sigmas)
        cost = _cost(rows)
        return _Linearised(there, rows, cost if math.isfinite(cost) else math.inf)

    def candidate(here: _Linearised, damping: float) -> _Linearised:
        weights = _weights(here.rows)
        normal = normal_equations([r.weighted(weights[name]) for name, r in here.rows.items()], damping)
        there = moved(here.state, data, *normal.step(damping))
        with np.errstate(all="ignore"):  # a step to invalid values has infinite cost and is rejected
            return at(there)

    found = levenberg_marquardt(
        at(state),
        candidate,
        lambda here, there: here.cost - there.cost,
        lambda here, there: abs(here.cost - there.cost) <= settled,
        damping=_DAMPING,
        most=_MOST_STEPS,
    )
    if found.stuck:
        raise ComputeError(
            "the bundle adjustment does not converge", remedy="Check the camera, the poses and the spheres"
        )
    return found.state.state, found.state.rows, found.steps


def _weights(rows: dict[str, Rows]) -> dict[str, Array]:
    """Return Cauchy weights of the measurements of each component; priors have weight one."""
    return {
        name: 1 / (1 + r.squares / CAUCHY[name] ** 2) if name in CAUCHY else np.ones(len(r.squares))
        for name, r in rows.items()
    }


def _cost(rows: dict[str, Rows]) -> float:
    total = 0.0
    for name, r in rows.items():
        if name in CAUCHY:
            c2 = CAUCHY[name] ** 2
            total += float(np.sum(c2 * np.log1p(r.squares / c2)))
        else:
            total += float(np.sum(r.squares))
    return total


def _redundancy(weighted: dict[str, Rows], normal: Normal, covariance: Array) -> dict[str, float]:
    """Return the redundancy of each component: its rows less the parameters that they determine."""
    out: dict[str, float] = {}
    left = float(sum(len(r.residual) for r in weighted.values()) - len(covariance) - normal.cross.shape[1])
    for name, r in weighted.items():
        if name == "tracks":
            continue
        J = reduced_rows(r, normal)
        taken = np.einsum("ij,jk,ik->", J, covariance, J) + taken_by_points(r, normal)
        out[name] = len(r.residual) - float(taken)
        left -= out[name]
    return {"tracks": left, **out}


def _estimated(sigmas: Sigmas, chi2: dict[str, float], redundancy: dict[str, float]) -> Sigmas:
    """Return the sigmas for the next round; a component with almost no redundancy keeps its own."""

    def factor(name: str) -> float:
        return math.sqrt(chi2[name]) if redundancy.get(name, 0) >= 6 and chi2[name] > 0 else 1.0

    return dataclasses.replace(
        sigmas,
        track_px=max(_LEAST.track_px, sigmas.track_px * factor("tracks")),
        sphere=max(_LEAST.sphere, sigmas.sphere * factor("spheres")),
        robot_m=max(_LEAST.robot_m, sigmas.robot_m * factor("robot_position")),
        robot_rad=max(_LEAST.robot_rad, sigmas.robot_rad * factor("robot_rotation")),
    )


def robust_rows(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> dict[str, Rows]:
    """Return the rows of every component with their robust weights."""
    rows = linearise(state, data, sigmas)
    weights = _weights(rows)
    return {name: r.weighted(weights[name]) for name, r in rows.items()}


# Covariance of an adjusted state with robust weights, valid if the errors within a track are correlated.
#
# A robust estimate has the covariance H^-1 M H^-1, where H is the slope of its score and M the covariance of the
# score (Huber, Robust Statistics, 6.3: the sandwich). For spheres and robot poses, both follow from the normal
# distribution. For tracks, M is estimated from the scores of whole tracks, which are independent of one another.


CAUCHY = {"tracks": 2.4, "spheres": 3.0, "robot_position": 3.0, "robot_rotation": 3.0}  # scale, in sigmas
_CHUNK = 2000  # tracks whose scores are dense at a time
_RANK = 1e-10  # eigenvalues of the scaled information below this share of the largest are zero


@dataclass(frozen=True, slots=True)
class CauchyMoments:
    """Means over normal residuals r of unit variance, per dimension, under Cauchy weights w.

    Attributes:
        square: E[w r²].
        influence: E[w² r²], the variance of the score.
        weight: E[w].
        slope: mean derivative of w r, the slope of the score.
    """

    square: float
    influence: float
    weight: float
    slope: float


def _expected(scale: float, dimensions: int) -> CauchyMoments:
    s = np.linspace(0.0, 80.0, 20001)[1:]
    density = s ** (dimensions / 2 - 1) * np.exp(-s / 2)
    density /= density.sum()
    w = 1 / (1 + s / scale**2)
    slope = w - 2 * s / dimensions * w**2 / scale**2
    return CauchyMoments(
        float(density @ (w * s)) / dimensions,
        float(density @ (w**2 * s)) / dimensions,
        float(density @ w),
        float(density @ slope),
    )


EXPECTED = {name: _expected(scale, 2 if name == "tracks" else 3) for name, scale in CAUCHY.items()}


def stated_covariance(weighted: dict[str, Rows], n: int) -> Array:
    """Return the covariance (n, n) of the frame parameters, from every component's rows with their robust weights.

    Raises:
        ComputeError: the data leave a parameter undetermined.
    """
    sloped = {name: _scaled(rows, _ratio(name, "slope")) for name, rows in weighted.items()}
    normal = normal_equations(list(sloped.values()))
    _, score = clustered_information(weighted["tracks"], n)
    for name, rows in weighted.items():
        if name != "tracks":
            J = reduced_rows(rows, normal)
            score += _ratio(name, "influence") * J.T @ J
    inverse = inverse_information(normal.schur)
    return inverse @ score @ inverse


def clustered_information(tracks: Rows, n: int) -> tuple[Array, Array]:
    """Return H, M (n, n) of weighted tracks, points eliminated, for the covariance H^-1 M H^-1 of frame parameters.

    M is estimated from the scores of whole tracks, so it holds even if the errors within a track are correlated. With
    G tracks the plain sum of squared scores has rank G at most: for fewer tracks than parameters it would state that
    some parameters have no errors, and for a few times as many it is still too small where it is inverted. It is
    therefore shrunk towards a multiple of the information, which is what uncorrelated errors would give, as far as
    the scores' own scatter demands. Source: Ledoit and Wolf, "A well-conditioned estimator for large-dimensional
    covariance matrices", J. Multivariate Analysis 88, 2004, in coordinates in which the information is the unit
    matrix.
    """
    point = tracks.point.indices[tracks.point.indptr[:-1]] // 3
    n_rows, n_points = len(tracks.residual), int(point.max()) + 1
    inner = Rows(tracks.residual, tracks.frame, tracks.point[:, : 3 * n_points].tocsr(), tracks.size)
    information = normal_equations([inner]).schur
    spread = csr_matrix((tracks.residual, (point, np.arange(n_rows))), shape=(n_points, n_rows))
    # Residuals are smaller than errors by what the parameters take. What a point takes of its own residuals is no
    # part of a score and needs no correction.
    free = max(n_rows - 3 * n_points, 1)
    scores = (spread @ tracks.frame).tocsr() * np.sqrt(free / max(free - n, 1))
    return _ratio("tracks", "slope") * information, _shrunk(scores, information)


def _shrunk(scores: csr_matrix, information: Array) -> Array:
    """Return the sum (n, n) of squared scores (G, n), shrunk towards a multiple of the information."""
    total = (scores.T @ scores).toarray()
    diagonal = np.diag(information)
    d = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(information * np.outer(d, d))
    known = values > _RANK * values[-1]
    whitening = d[:, None] * vectors[:, known] / np.sqrt(values[known])
    count, rank = scores.shape[0], whitening.shape[1]
    sample = whitening.T @ total @ whitening
    level = float(np.trace(sample)) / rank
    fourth = sum(
        float(np.sum(np.sum((scores[first : first + _CHUNK] @ whitening) ** 2, axis=1) ** 2))
        for first in range(0, count, _CHUNK)
    )
    spread = float(np.sum((sample - level * np.eye(rank)) ** 2))
    scatter = fourth - float(np.sum(sample**2)) / count
    share = min(scatter / spread, 1.0) if spread > 0 else 1.0
    return share * level * information + (1 - share) * total


def reduced_rows(rows: Rows, normal: Normal) -> Array:
    """Return the derivative (R, n) of a component's residuals by the frame parameters, while the points follow these.

    A point's increment is -V^-1 W^T times the frame's, where V and W are the points' blocks of `normal`.
    """
    return rows.frame.toarray() - (rows.point @ _inverse_of_points(normal) @ normal.cross.T).toarray()


def taken_by_points(rows: Rows, normal: Normal) -> float:
    """Return the trace of P V^-1 P^T: how many of a component's rows (derivative P by the points) the points take."""
    return float(rows.point.multiply(rows.point @ _inverse_of_points(normal)).sum())


def _inverse_of_points(normal: Normal) -> bsr_matrix:
    count = len(normal.inverse_blocks)
    return bsr_matrix((normal.inverse_blocks, np.arange(count), np.arange(count + 1)))


def inverse_information(information: Array) -> Array:
    """Return the inverse (n, n) of an information matrix.

    Raises:
        ComputeError: it is singular.
    """
    diagonal = np.diag(information)
    if np.any(diagonal <= 0):
        raise ComputeError("a camera or a base is not determined by the data")
    d = 1 / np.sqrt(diagonal)
    scaled = information * np.outer(d, d)
    values = np.linalg.eigvalsh(scaled)
    if values[0] <= 1e-13 * values[-1]:
        raise ComputeError(
            "the adjustment is not determined: frame, scale or a camera is free",
            remedy="Use images that share texture and show at least three spheres",
        )
    return np.linalg.inv(scaled) * np.outer(d, d)


def _ratio(name: str, quantity: Literal["slope", "influence"]) -> float:
    """Return the expected slope or variance of a component's score over its expected weight; one for priors."""
    if name not in EXPECTED:
        return 1.0
    expected = EXPECTED[name]
    return (expected.slope if quantity == "slope" else expected.influence) / expected.weight


def _scaled(rows: Rows, factor: float) -> Rows:
    return rows.weighted(np.full(len(rows.residual) // rows.size, factor))
