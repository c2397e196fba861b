"""Covariance of an adjusted state with robust weights, valid if the errors within a track are correlated.

A robust estimate has the covariance H^-1 M H^-1, where H is the slope of its score and M the covariance of the score
(Huber, Robust Statistics, 6.3: the sandwich). For spheres and robot poses, both follow from the normal distribution.
For tracks, M is estimated from the scores of whole tracks, which are independent of one another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from service.compute.poses.hybrid.bundle import Normal, Rows, normal_equations
from service.core.errors import ComputeError
from service.core.geometry import Array

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
    """Covariance (n, n) of the frame parameters, from every component's rows with their robust weights.

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
    """H and M (n, n) of weighted tracks, points eliminated, for the covariance H^-1 M H^-1 of the frame parameters.

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
    """Sum (n, n) of squared scores (G, n), shrunk towards a multiple of the information."""
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
    """Derivative (R, n) of a component's residuals by the frame parameters, while the points follow these.

    A point's increment is -V^-1 W^T times the frame's, where V and W are the points' blocks of `normal`.
    """
    return rows.frame.toarray() - (rows.point @ _inverse_of_points(normal) @ normal.cross.T).toarray()


def taken_by_points(rows: Rows, normal: Normal) -> float:
    """Trace of P V^-1 P^T: how many of a component's rows (derivative P by the points) the points themselves take."""
    return float(rows.point.multiply(rows.point @ _inverse_of_points(normal)).sum())


def _inverse_of_points(normal: Normal) -> bsr_matrix:
    count = len(normal.inverse_blocks)
    return bsr_matrix((normal.inverse_blocks, np.arange(count), np.arange(count + 1)))


def inverse_information(information: Array) -> Array:
    """Inverse (n, n) of an information matrix.

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
    """Expected slope or variance of a component's score over its expected weight; one for priors, which have none."""
    if name not in EXPECTED:
        return 1.0
    expected = EXPECTED[name]
    return (expected.slope if quantity == "slope" else expected.influence) / expected.weight


def _scaled(rows: Rows, factor: float) -> Rows:
    return rows.weighted(np.full(len(rows.residual) // rows.size, factor))
