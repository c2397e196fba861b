"""Covariance of the poses of structure from motion, whose frame and scale are free, and its file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from service.compute.camera_covariance import CameraCovariance
from service.compute.camera_model import CameraModel
from service.compute.poses.hybrid.adjustment import first_guess, robust_rows
from service.compute.poses.hybrid.bundle import AdjustmentData, BundleState, Rows, Sigmas, normal_equations
from service.compute.poses.hybrid.rows import linearise
from service.compute.poses.hybrid.stated_covariance import clustered_information
from service.compute.poses.sfm.tracks import Tracks
from service.core.errors import ComputeError
from service.core.geometry import Array


def similarity_covariance(
    T_world_camera: Array, tracks: Tracks, camera: CameraModel, known: CameraCovariance | None = None
) -> Array:
    """Joint covariance (6 N, 6 N) of poses at the solution of a bundle adjustment with the camera fixed.

    From the normal equations with the points eliminated and robust weights, allowing for errors shared within a
    track. Frame and scale are free: the covariance is that of the poses after a similarity has aligned their
    positions with the true ones (inner constraints; Triggs et al., "Bundle adjustment", 2000, 9.2.2).

    Args:
        T_world_camera: (N, 4, 4), any unit.
        tracks: of the same images, in the same frame.
        camera: intrinsics.
        known: covariance of the camera that was fixed; its error moves all poses together, however many images there
            are. None: the camera is taken as exact.

    Returns:
        (6 N, 6 N) of increments (d in the model's unit, w in radians) of exp(w) R, t + d in the model's axes.

    Raises:
        ComputeError: an image or a point has too few observations.
    """
    n = len(T_world_camera)
    state = BundleState(T_world_camera, tracks.points, np.empty((0, 4, 4)), camera)
    data = AdjustmentData(tracks)
    rows = robust_rows(state, data, first_guess(state, data, Sigmas()))
    bread, meat = clustered_information(rows["tracks"], 6 * n)
    # The images do not determine seven directions: translation, rotation and scale.
    positions = T_world_camera[:, :3, 3] - T_world_camera[:, :3, 3].mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(positions**2, axis=1))))
    gauge = np.zeros((n, 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, :3, 3:6] = np.array([np.cross(np.eye(3), p).T for p in positions])
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, :3, 6] = positions
    G = gauge.reshape(6 * n, 7)
    unit = np.tile([spread] * 3 + [1.0] * 3, n)
    B = bread * np.outer(unit, unit)
    Q = np.linalg.qr(G / unit[:, None])[0]
    level = float(np.median(np.diag(B)))
    inverse = np.linalg.inv(B + level * Q @ Q.T) * np.outer(unit, unit)
    if not np.all(np.isfinite(inverse)):
        raise ComputeError("the poses of structure from motion are not determined by its tracks")
    fixed = gauge.copy()
    fixed[:, 3:] = 0.0  # only positions define the alignment
    E = fixed.reshape(6 * n, 7)
    S = np.eye(6 * n) - G @ np.linalg.solve(E.T @ G, E.T)
    half = S @ inverse
    covariance = half @ meat @ half.T
    for pull in _pulls(state, data, rows["tracks"], bread, known) if known is not None else ():
        moved = half @ pull
        covariance = covariance + np.outer(moved, moved)
    return covariance


def _pulls(
    state: BundleState, data: AdjustmentData, tracks: Rows, bread: Array, known: CameraCovariance
) -> Iterator[Array]:
    """(6 N,) change of the poses' gradient for each deviation of the camera, with the points adjusted."""
    plain = linearise(state, data, Sigmas())["tracks"]
    # The square roots of the robust weights, over the sigma that they were found with.
    root = np.sqrt(_row_squares(tracks) / np.maximum(_row_squares(plain), 1e-300))
    for camera in known.deviations(state.camera):
        off = linearise(dataclasses.replace(state, camera=camera), data, Sigmas())["tracks"].residual - plain.residual
        normal = normal_equations([dataclasses.replace(tracks, residual=root * off)])
        n = len(bread)
        yield normal.gradient[:n] * float(np.trace(bread) / np.trace(normal.schur[:n, :n]))


def _row_squares(rows: Rows) -> Array:
    return np.asarray(rows.frame.multiply(rows.frame).sum(axis=1), dtype=np.float64).ravel()


def blocks(covariance: Array) -> Array:
    """(N, 6, 6) covariance of each pose, from a joint covariance (6 N, 6 N)."""
    n = len(covariance) // 6
    return np.array([covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(n)])


def write_pose_covariance(path: Path, names: Sequence[str], pose_covariance: Array, unit: str) -> None:
    """Write (N, 6, 6) beside a model; `unit` is that of the positions: "m" or "model"."""
    document = {
        "order": ["x", "y", "z", "rx_rad", "ry_rad", "rz_rad"],
        "increment": "T_world_camera: exp(w) R, t + d, in the axes of the world",
        "position_unit": unit,
        "covariance": {name: C.tolist() for name, C in zip(names, pose_covariance, strict=True)},
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
