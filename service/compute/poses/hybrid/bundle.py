"""Bundle adjustment: cameras, scene points, spheres and robot bases in one sparse least-squares problem.

Points are eliminated by the Schur complement (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, 6.1).
A pose's increment (d, w) is exp(w) R, t + d in the axes of the outer frame.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, vstack
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import ObservedCones
from service.compute.poses.sfm.tracks import Tracks
from service.core.errors import ComputeError
from service.core.geometry import Array

Index = NDArray[np.int64]
LENS = ("fx", "fy", "cx", "cy")
COMMON = ("shift_x", "shift_y", "growth", "light_x", "light_y", "light_z")
_CHUNK = 2000  # points eliminated at a time


@dataclass(frozen=True, slots=True)
class BundleState:
    """The estimated quantities. `points` are those of the tracks, followed by the spheres' centres."""

    cameras: Array  # (N, 4, 4) T_frame_camera
    points: Array  # (P + M, 3) in the frame
    bases: Array  # (G, 4, 4) T_frame_base
    camera: CameraModel
    common: Array = field(default_factory=lambda: np.zeros(len(COMMON)))  # px, errors shared by all outlines


@dataclass(frozen=True, slots=True)
class SphereSightings:
    """Outlines of S spheres as cones."""

    image: Index  # (S,)
    marker: Index  # (S,)
    cones: ObservedCones
    whitening: Array  # (S, 3, 3) W with W C W^T = I for the cone's covariance C


@dataclass(frozen=True, slots=True)
class AdjustmentData:
    """The measurements. Sigmas: px for tracks, (m, rad) for the robot, metres for the spheres' positions."""

    tracks: Tracks
    sightings: SphereSightings | None = None
    centres: Array | None = None  # (M, 3) spheres in the frame
    centre_whitening: Array | None = None  # (M, 3, 3) W with W C W^T = I for the covariance C of a centre
    common_sigma_px: Array | None = None  # (6,) of COMMON
    light_unit_m: float = 0.0  # displacement of the spheres in space per pixel of light error
    radius_m: float = 0.0
    robot: Array | None = None  # (N, 4, 4) T_base_camera; NaN for images without one
    group: Index | None = None  # (N,) index into the bases
    calibrated: CameraModel | None = None  # the camera with which the cones were made
    lens_covariance: Array | None = None  # (4, 4) of its fx, fy, cx, cy; None: the camera is fixed


@dataclass(frozen=True, slots=True)
class Sigmas:
    """Standard deviations of the components; `sphere` is a factor on the outlines' own."""

    track_px: float = 0.4
    sphere: float = 1.0
    robot_m: float = 1e-3
    robot_rad: float = 2e-3


@dataclass(frozen=True, slots=True)
class Rows:
    """Whitened residuals of one component and their derivatives by frame parameters and points."""

    residual: Array  # (R,)
    frame: csr_matrix  # (R, n)
    point: csr_matrix  # (R, 3 (P + M))
    size: int  # rows per measurement, which share a robust weight

    def weighted(self, weights: Array) -> Rows:
        """The rows multiplied by the square root of their measurement's weight (R / size,)."""
        root = np.repeat(np.sqrt(weights), self.size)
        scale = coo_matrix((root, (np.arange(len(root)), np.arange(len(root))))).tocsr()
        return Rows(self.residual * root, (scale @ self.frame).tocsr(), (scale @ self.point).tocsr(), self.size)

    @property
    def squares(self) -> Array:
        """(R / size,) squared length of each measurement's residual."""
        return np.sum(self.residual.reshape(-1, self.size) ** 2, axis=1)


def width(state: BundleState, data: AdjustmentData) -> int:
    """Number of frame parameters: six per camera, six per base, the errors shared by outlines, and the lens."""
    return lens_column(state, data) + (len(LENS) if data.lens_covariance is not None else 0)


def common_column(state: BundleState) -> int:
    """First column of the errors that all outlines share."""
    return 6 * (len(state.cameras) + len(state.bases))


def lens_column(state: BundleState, data: AdjustmentData) -> int:
    """First column of the lens."""
    return common_column(state) + (len(COMMON) if data.sightings is not None else 0)


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations with the points eliminated."""

    schur: Array  # (n, n)
    gradient: Array  # (n,)
    cross: csc_matrix  # (n, 3 Q)
    inverse_blocks: Array  # (Q, 3, 3) of the points
    point_gradient: Array  # (Q, 3)

    def step(self, damping: float) -> tuple[Array, Array]:
        """Increment of the frame parameters (n,) and of the points (Q, 3)."""
        diagonal = np.diag(self.schur)
        d = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = self.schur * np.outer(d, d) + damping * np.eye(len(d))
        frame = -d * np.linalg.solve(scaled, d * self.gradient)
        right = self.point_gradient + (self.cross.T @ frame).reshape(-1, 3)
        return frame, -np.einsum("qij,qj->qi", self.inverse_blocks, right)


def normal_equations(rows: list[Rows], damping: float = 0.0) -> Normal:
    """Normal equations of all rows, with the points eliminated.

    Raises:
        ComputeError: a point is not determined by its observations.
    """
    A, B = vstack([r.frame for r in rows]).tocsr(), vstack([r.point for r in rows]).tocsr()
    r = np.concatenate([c.residual for c in rows])
    n_points = B.shape[1] // 3
    blocks = np.zeros((n_points, 3, 3))
    V = (B.T @ B).tobsr((3, 3))
    V.sort_indices()
    if len(V.data) != n_points:
        raise ComputeError("a scene point has no observation that determines it")
    blocks[:] = V.data
    trace = np.trace(blocks, axis1=1, axis2=2)
    blocks += (damping + 1e-12) * trace[:, None, None] / 3 * np.eye(3)
    inverse = np.linalg.inv(blocks)
    W = (A.T @ B).tocsc()
    point_gradient = (B.T @ r).reshape(-1, 3)
    schur = (A.T @ A).toarray()
    half = np.linalg.cholesky(inverse)
    for first in range(0, n_points, _CHUNK):  # dense blocks are much faster than sparse matrix products
        mine = slice(first, min(first + _CHUNK, n_points))
        piece = W[:, 3 * mine.start : 3 * mine.stop].toarray().reshape(len(schur), -1, 3)
        piece = np.einsum("npi,pij->npj", piece, half[mine]).reshape(len(schur), -1)
        schur -= piece @ piece.T
    gradient = A.T @ r - W @ np.einsum("qij,qj->qi", inverse, point_gradient).ravel()
    return Normal(schur, gradient, W, inverse, point_gradient)


def moved(state: BundleState, data: AdjustmentData, frame: Array, points: Array) -> BundleState:
    """The state after an increment of the frame parameters (n,) and the points (Q, 3)."""
    n, g = len(state.cameras), len(state.bases)
    camera = state.camera
    if data.lens_covariance is not None:
        change = frame[lens_column(state, data) :]
        values = {name: getattr(camera, name) + float(d) for name, d in zip(LENS, change, strict=True)}
        camera = dataclasses.replace(camera, **values)
    return BundleState(
        _turned(state.cameras, frame[: 6 * n].reshape(-1, 6)),
        state.points + points,
        _turned(state.bases, frame[6 * n : 6 * (n + g)].reshape(-1, 6)),
        camera,
        state.common if data.sightings is None else state.common + frame[6 * (n + g) :][: len(COMMON)],
    )


def _turned(poses: Array, steps: Array) -> Array:
    out = poses.copy()
    if len(poses):
        out[:, :3, :3] = Rotation.from_rotvec(steps[:, 3:]).as_matrix() @ poses[:, :3, :3]
        out[:, :3, 3] += steps[:, :3]
    return out


def whitening_of(covariance: Array) -> Array:
    """(..., k, k) W with W C W^T = I for covariances C."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)
