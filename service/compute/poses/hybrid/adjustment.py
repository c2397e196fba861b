"""Robust solution of a bundle adjustment, with variance components and the covariance of its poses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from service.compute.descent import Damping, levenberg_marquardt
from service.compute.poses.hybrid.bundle import (
    AdjustmentData,
    BundleState,
    Normal,
    Rows,
    Sigmas,
    moved,
    normal_equations,
)
from service.compute.poses.hybrid.rows import linearise
from service.compute.poses.hybrid.stated_covariance import (
    CAUCHY,
    EXPECTED,
    inverse_information,
    reduced_rows,
    stated_covariance,
    taken_by_points,
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
        state: cameras, points, bases, camera.
        sigmas: of the components, estimated.
        weights: robust weight of each measurement, by component.
        covariance: (n, n) of the frame parameters, points eliminated.
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
    """Cauchy weights of the measurements of each component; priors have weight one."""
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
    """Redundancy of each component: its rows less the parameters that they determine."""
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


def robust_rows(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> dict[str, Rows]:
    """Rows of every component with their robust weights."""
    rows = linearise(state, data, sigmas)
    weights = _weights(rows)
    return {name: r.weighted(weights[name]) for name, r in rows.items()}
