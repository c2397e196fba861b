"""Robust solution of a bundle adjustment, with variance components and the covariance of its poses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix

from service.compute.descent import Damping, levenberg_marquardt
from service.compute.poses.hybrid.bundle import Data, Normal, Rows, Sigmas, State, linearise, moved, normal_equations
from service.core.errors import ComputeError
from service.core.geometry import Array

_CAUCHY = {"tracks": 2.4, "spheres": 3.0, "robot_position": 3.0, "robot_rotation": 3.0}  # scale, in sigmas
_SETTLED = 0.2  # change of the cost (a chi square of all residuals) below which an adjustment has converged
_NEARLY = 5.0  # the same while the variances are still being estimated
_MOST_STEPS = 40
_DAMPING = Damping(1e-6, down=10, up=30, least=1e-9)
_LEAST = Sigmas(track_px=0.02, sphere=0.3, robot_m=1e-5, robot_rad=1e-5)  # lower bounds of the estimates


@dataclass(frozen=True, slots=True)
class Solution:
    """The adjusted state.

    Attributes:
        state: cameras, points, bases, camera.
        sigmas: of the components, estimated.
        weights: robust weight of each measurement, by component.
        covariance: (n, n) of the frame parameters, points eliminated.
        chi2: reduced chi square of each component, with robust weights and its own redundancy.
        redundancy: of each component; their sum plus the number of parameters is the number of rows.
        steps: number of linearisations.
    """

    state: State
    sigmas: Sigmas
    weights: dict[str, Array]
    covariance: Array
    chi2: dict[str, float]
    redundancy: dict[str, float]
    steps: int


def solve(state: State, data: Data, sigmas: Sigmas, *, rounds: int = 3) -> Solution:
    """Levenberg–Marquardt with Cauchy weights; the components' variances are estimated between rounds.

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
        covariance = _inverse(normal.schur)
        redundancy = _redundancy(weighted, normal, covariance)
        chi2 = {
            name: float(np.sum(r.squares))
            / max(redundancy[name], 1e-3)
            / (_EXPECTED[name][0] if name in _EXPECTED else 1)
            for name, r in weighted.items()
        }
        if turn + 1 < rounds:
            sigmas = _estimated(sigmas, chi2, redundancy)
        else:
            covariance = _honest(weighted, normal)
    return Solution(state, sigmas, weights, covariance, chi2, redundancy, steps)


def first_guess(state: State, data: Data, sigmas: Sigmas) -> Sigmas:
    """Sigmas with the tracks' from the median of their residuals, so that robust weights work from the start."""
    squares = linearise(state, dataclasses.replace(data, sightings=None, robot=None, lens_covariance=None), sigmas)[
        "tracks"
    ].squares
    return dataclasses.replace(
        sigmas,
        track_px=max(_LEAST.track_px, sigmas.track_px * math.sqrt(float(np.median(squares)) / (2 * math.log(2)))),
    )


@dataclass(frozen=True, slots=True)
class _Linearised:
    state: State
    rows: dict[str, Rows]
    cost: float


def _descend(state: State, data: Data, sigmas: Sigmas, settled: float) -> tuple[State, dict[str, Rows], int]:
    def at(there: State) -> _Linearised:
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
            "the bundle adjustment does not converge", remedy="check the camera, the poses and the spheres"
        )
    return found.state.state, found.state.rows, found.steps


def _weights(rows: dict[str, Rows]) -> dict[str, Array]:
    """Cauchy weights of the measurements of each component; priors have weight one."""
    return {
        name: 1 / (1 + r.squares / _CAUCHY[name] ** 2) if name in _CAUCHY else np.ones(len(r.squares))
        for name, r in rows.items()
    }


def _cost(rows: dict[str, Rows]) -> float:
    total = 0.0
    for name, r in rows.items():
        if name in _CAUCHY:
            c2 = _CAUCHY[name] ** 2
            total += float(np.sum(c2 * np.log1p(r.squares / c2)))
        else:
            total += float(np.sum(r.squares))
    return total


def _inverse(schur: Array) -> Array:
    diagonal = np.diag(schur)
    if np.any(diagonal <= 0):
        raise ComputeError("a camera or a base is not determined by the data")
    d = 1 / np.sqrt(diagonal)
    scaled = schur * np.outer(d, d)
    values = np.linalg.eigvalsh(scaled)
    if values[0] <= 1e-13 * values[-1]:
        raise ComputeError(
            "the adjustment is not determined: frame, scale or a camera is free",
            remedy="Use images that share texture and show at least three spheres",
        )
    return np.linalg.inv(scaled) * np.outer(d, d)


def _redundancy(weighted: dict[str, Rows], normal: Normal, covariance: Array) -> dict[str, float]:
    """Redundancy of each component: its rows less the parameters that they determine."""
    out: dict[str, float] = {}
    cross = normal.cross
    left = float(sum(len(r.residual) for r in weighted.values()) - len(covariance) - cross.shape[1])
    for name, r in weighted.items():
        if name == "tracks":
            continue
        J = r.frame.toarray()
        if r.point.nnz:
            # A point's increment is -V^-1 W^T of the cameras' increment, plus the part from its own rows.
            used = np.unique(r.point.indices // 3)
            columns = (3 * used[:, None] + np.arange(3)).ravel()
            inverse = block_diag(*normal.inverse_blocks[used])
            P = r.point[:, columns].toarray()
            G = inverse @ cross[:, columns].T.toarray()
            full = J - P @ G
            taken = np.einsum("ij,jk,ik->", full, covariance, full) + np.einsum("ij,jk,ik->", P, inverse, P)
        else:
            taken = np.einsum("ij,jk,ik->", J, covariance, J)
        out[name] = len(r.residual) - float(taken)
        left -= out[name]
    return {"tracks": left, **out}


def _estimated(sigmas: Sigmas, chi2: dict[str, float], redundancy: dict[str, float]) -> Sigmas:
    """Sigmas for the next round; a component with almost no redundancy keeps its own."""

    def factor(name: str) -> float:
        return math.sqrt(chi2[name]) if redundancy.get(name, 0) >= 6 and chi2[name] > 0 else 1.0

    return dataclasses.replace(
        sigmas,
        track_px=max(_LEAST.track_px, sigmas.track_px * factor("tracks")),
        sphere=max(_LEAST.sphere, sigmas.sphere * factor("spheres")),
        robot_m=max(_LEAST.robot_m, sigmas.robot_m * factor("robot_position")),
        robot_rad=max(_LEAST.robot_rad, sigmas.robot_rad * factor("robot_rotation")),
    )


def robust_rows(state: State, data: Data, sigmas: Sigmas) -> dict[str, Rows]:
    """Rows of every component with their robust weights."""
    rows = linearise(state, data, sigmas)
    weights = _weights(rows)
    return {name: r.weighted(weights[name]) for name, r in rows.items()}


def clustered_information(tracks: Rows, n: int) -> tuple[Array, Array]:
    """H and M (n, n) of weighted tracks, points eliminated, for the covariance H^-1 M H^-1 of the frame parameters.

    It holds even if the errors within a track are correlated: M sums the squared scores of whole tracks. Source: the
    sandwich estimator of robust estimation (Huber, Robust Statistics, 6.3) with clusters.
    """
    point = tracks.point.indices[tracks.point.indptr[:-1]] // 3
    n_rows, n_points = len(tracks.residual), int(point.max()) + 1
    inner = Rows(tracks.residual, tracks.frame, tracks.point[:, : 3 * n_points].tocsr(), tracks.size)
    spread = csr_matrix((tracks.residual, (point, np.arange(n_rows))), shape=(n_points, n_rows))
    scores = (spread @ tracks.frame).tocsr()
    free = max(n_rows - 3 * n_points - n, 1)
    _, weight, slope = _EXPECTED["tracks"]
    return normal_equations([inner]).schur * slope / weight, (scores.T @ scores).toarray() * n_rows / free


def _honest(weighted: dict[str, Rows], normal: Normal) -> Array:
    """Covariance of the frame parameters; tracks by clustered scores, the other components by their stated sigmas."""
    bread, meat = clustered_information(weighted["tracks"], len(normal.schur))
    _, weight, slope = _EXPECTED["tracks"]
    rest = normal.schur - bread * weight / slope
    inverse = _inverse(rest + bread)
    return inverse @ (rest + meat) @ inverse


def _expectations(scale: float, dimensions: int) -> tuple[float, float, float]:
    """E[w s], E[w] and the mean slope of w r, per dimension, for Gaussian residuals r under Cauchy weights w."""
    s = np.linspace(0.0, 80.0, 20001)[1:]
    density = s ** (dimensions / 2 - 1) * np.exp(-s / 2)
    density /= density.sum()
    w = 1 / (1 + s / scale**2)
    slope = w - 2 * s / dimensions * w**2 / scale**2
    return float(density @ (w * s)) / dimensions, float(density @ w), float(density @ slope)


_EXPECTED = {name: _expectations(scale, 2 if name == "tracks" else 3) for name, scale in _CAUCHY.items()}
