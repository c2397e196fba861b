"""Variance components: the noise of outlines and poses, estimated from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from service.compute.registration.least_squares.normal_equations import Blocks, marginalise
from service.core.geometry import Array

_FACTOR = (0.02, 1e4)  # range for the outlines' variance
_POSE = (1e-3, 1e3)  # range for the square roots below
_GROWTH = 5.0  # largest growth of the square roots of the pose noise in one estimate


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Square roots of the covariances of the pose errors, as a sum of parts with one factor each.

    `parts` (K, N, 6, 6) must act on different rows (translation, rotation), or there is only one; `least` is the
    smallest allowed factor; `free` tells whether the factors are estimated.
    """

    parts: Array
    least: float
    free: bool

    def root(self, factors: Array) -> Array:
        """(N, 6, 6) such that root @ root.T is the covariance."""
        return np.einsum("k,knij->nij", factors, self.parts)


def no_pose_noise(n_images: int) -> PoseNoise:
    """No pose errors: poses taken as exact."""
    return PoseNoise(np.zeros((1, n_images, 6, 6)), 1.0, free=False)


def free_poses(n_images: int) -> PoseNoise:
    """Poses that tell nothing: 0.1 m and 0.1 rad, hundreds of times what the outlines of four spheres leave open."""
    return PoseNoise(np.tile(0.1 * np.eye(6), (1, n_images, 1, 1)), 1.0, free=False)


def unknown_pose_noise(n_images: int) -> PoseNoise:
    """Isotropic noise of position and of orientation, equal for all images, in units of 0.1 mm and 0.1 mrad."""
    parts = np.zeros((2, n_images, 6, 6))
    parts[0, :, :3, :3] = 1e-4 * np.eye(3)
    parts[1, :, 3:, 3:] = 1e-4 * np.eye(3)
    return PoseNoise(parts, _POSE[0], free=True)


def given_pose_noise(covariance: Array) -> PoseNoise:
    """The stated covariances (N, 6, 6); the residuals can increase them, never decrease them."""
    values, vectors = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return PoseNoise(root[None], 1.0, free=True)


def estimate(
    blocks: Blocks, noise: PoseNoise, prior: Array, prior_gradient: Array, start: tuple[float, Array]
) -> tuple[float, Array]:
    """Estimate the variance factors of the outlines and of the pose noise (K,) by restricted maximum likelihood.

    Args:
        blocks: linearised at the current solution.
        noise: the form of the pose noise.
        prior: (n, n) prior information on the common unknowns.
        prior_gradient: (n,) gradient of the prior at the current solution.
        start: current values.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal",
    Biometrika 58(3), 1971. A wide prior on the logarithm of the outlines' factor limits the influence of few
    residuals.

    The pose noise grows at most fivefold at a time. If residuals are far larger than stated, the minimiser's first
    step would otherwise make the poses carry no information, from which neither it nor the solution recovers.
    """
    n_free = len(start[1]) if noise.free else 0
    most = np.log(np.clip(_GROWTH * start[1][:n_free], max(noise.least, _POSE[0]) * _GROWTH, _POSE[1]))
    lower = [np.log(_FACTOR[0]) / 2, *([np.log(noise.least)] * n_free)]
    upper = [np.log(_FACTOR[1]) / 2, *most.tolist()]

    def cost(y: Array) -> float:
        factor = float(np.exp(2 * y[0]))
        scales = np.exp(y[1:]) if n_free else start[1]
        m = marginalise(blocks, noise.root(scales), factor)
        H, g = m.H + prior, m.g + prior_gradient
        # A common unknown on which these poses have no information, except by rounding, is left out.
        told = np.diag(H) > 0
        d = np.where(told, 1 / np.sqrt(np.where(told, np.diag(H), 1.0)), 0.0)
        values, vectors = np.linalg.eigh(H * np.outer(d, d))
        good = values > 1e-13
        projected = vectors.T @ (d * g)
        gain = float(np.sum(projected[good] ** 2 / values[good]))
        log_H = float(np.sum(np.log(values[good])) - 2 * np.sum(np.log(d[told])))
        return m.quadratic - gain + m.log_determinant + log_H + y[0] ** 2

    at = np.clip(
        np.concatenate([[0.5 * np.log(start[0])], np.log(np.maximum(start[1][:n_free], 1e-12))]), lower, upper
    )
    best = minimize(cost, at, method="L-BFGS-B", bounds=list(zip(lower, upper, strict=True)))
    y = np.asarray(best.x, dtype=np.float64)
    return float(np.exp(2 * y[0])), np.exp(y[1:]) if n_free else start[1]
