"""Predictions of a registration for outlines that were not used in it, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.compute.markers.records import SphereOutline
from service.compute.registration.least_squares.problem import linearise, with_outlines
from service.compute.registration.result import Solution
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class HeldOutRows:
    """Whitened rows of O outlines outside the solution: r + J dx + A xi."""

    image: NDArray[np.int64]
    J: Array  # (O, 3, n)
    A: Array  # (O, 3, 6)
    r: Array  # (O, 3) at the solution, with the pose as given
    whiten: Array  # (O, 3, 3)
    by_centre: Array | None = (
        None  # (O, 3, 3) by a displacement of the sphere in the scan frame, if its centre is uncertain
    )


@dataclass(frozen=True, slots=True)
class Prediction:
    """Error of an outline's prediction, and the predicted size of that error."""

    normalised: float  # rms of the outline's three residuals over their predicted standard deviations
    sigma_rad: float  # predicted rms distance of the outline's points from the prediction


def held_out_rows(
    solution: Solution,
    outlines: Sequence[Sequence[SphereOutline]],
    members: list[tuple[int, int, int]],
    centres_scan_m: Array,
) -> HeldOutRows:
    """Rows of outlines of other spheres, (C, 3) in the scan frame; members are (image, outline, sphere)."""
    own = solution.problem
    problem = replace(with_outlines(own, outlines, members), centres=np.asarray(centres_scan_m), sphere_prior=None)
    state = replace(solution.state, spheres=np.zeros_like(problem.centres))
    rows = linearise(problem, state, "cone")
    J = np.zeros((len(members), 3, own.size))
    J[:, :, : own.sphere_column] = rows.J[:, :, : own.sphere_column]
    J[:, :, own.common_column :] = rows.J[:, :, own.sphere_column :]
    position = np.arange(3) + 6 * problem.group[:, None]
    shift = np.take_along_axis(rows.J, position[:, None, :], axis=2)
    by_centre = shift @ solution.state.bases[problem.group, :3, :3]
    return HeldOutRows(problem.image, J, rows.A, rows.r, problem.whiten, by_centre)


def predict(
    solution: Solution, rows: HeldOutRows, *, refined: bool, centre_covariance_m2: Array | None = None
) -> list[Prediction]:
    """Residuals of outlines, compared with their predicted covariance.

    Args:
        solution: without these outlines.
        rows: linearised at the solution.
        refined: whether the prediction uses the pose corrected by its estimated error, or the pose as given.
        centre_covariance_m2: (O, 3, 3) of each outline's sphere, scan frame.
    """
    gain, Q = solution.pose_gain()[rows.image], solution.marginal.Q[rows.image]
    spread = solution.covariance
    if refined:
        r = rows.r + np.einsum("okj,oj->ok", rows.A, solution.state.poses[rows.image])
        both = rows.J + rows.A @ gain
        predicted = both @ spread @ both.transpose(0, 2, 1) + rows.A @ Q @ rows.A.transpose(0, 2, 1)
    else:
        # The pose's full error counts, except the part that the solution has absorbed.
        r = rows.r
        root = solution.pose_root[rows.image]
        cross = rows.J @ spread @ gain.transpose(0, 2, 1) @ rows.A.transpose(0, 2, 1)
        own = rows.A @ root @ root.transpose(0, 2, 1) @ rows.A.transpose(0, 2, 1)
        predicted = rows.J @ spread @ rows.J.transpose(0, 2, 1) + own + cross + cross.transpose(0, 2, 1)
    if centre_covariance_m2 is not None and rows.by_centre is not None:
        predicted = predicted + rows.by_centre @ centre_covariance_m2 @ rows.by_centre.transpose(0, 2, 1)
    V = predicted + solution.outline_factor * np.eye(3)
    square = np.einsum("oi,oi->o", r, np.linalg.solve(V, r[:, :, None])[:, :, 0])
    colour = np.linalg.inv(rows.whiten)
    size = colour @ V @ colour.transpose(0, 2, 1)
    sigma = np.sqrt((size[:, 0, 0] + size[:, 1, 1]) / 2 + size[:, 2, 2])
    return [Prediction(float(np.sqrt(q / 3)), float(s)) for q, s in zip(square, sigma, strict=True)]
