"""States bundle adjustment as a sparse least-squares problem: cameras, scene points, spheres and robot bases."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, vstack
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import ObservedCones
from service.compute.sfm.features import Tracks
from service.core.errors import ComputeError
from service.core.geometry import Array, skew

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
        """Return the rows multiplied by the square root of their measurement's weight (R / size,)."""
        root = np.repeat(np.sqrt(weights), self.size)
        scale = coo_matrix((root, (np.arange(len(root)), np.arange(len(root))))).tocsr()
        return Rows(self.residual * root, (scale @ self.frame).tocsr(), (scale @ self.point).tocsr(), self.size)

    @property
    def squares(self) -> Array:
        """(R / size,) squared length of each measurement's residual."""
        return np.sum(self.residual.reshape(-1, self.size) ** 2, axis=1)


def width(state: BundleState, data: AdjustmentData) -> int:
    """Count the frame parameters: six per camera, six per base, the errors shared by outlines, and the lens."""
    return lens_column(state, data) + (len(LENS) if data.lens_covariance is not None else 0)


def common_column(state: BundleState) -> int:
    """Return the first column of the errors that all outlines share."""
    return 6 * (len(state.cameras) + len(state.bases))


def lens_column(state: BundleState, data: AdjustmentData) -> int:
    """Return the first column of the lens."""
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
        """Return the increment of the frame parameters (n,) and of the points (Q, 3)."""
        diagonal = np.diag(self.schur)
        d = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = self.schur * np.outer(d, d) + damping * np.eye(len(d))
        frame = -d * np.linalg.solve(scaled, d * self.gradient)
        right = self.point_gradient + (self.cross.T @ frame).reshape(-1, 3)
        return frame, -np.einsum("qij,qj->qi", self.inverse_blocks, right)


def normal_equations(rows: list[Rows], damping: float = 0.0) -> Normal:
    """Build the normal equations of all rows, with the points eliminated.

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
    """Return the state after an increment of the frame parameters (n,) and the points (Q, 3)."""
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
    """Return (..., k, k) W with W C W^T = I for covariances C."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)


def linearise(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> dict[str, Rows]:
    """Return the rows of every component in the data: tracks, spheres, centres, common, robot_position …, lens."""
    out = {"tracks": _track_rows(state, data, sigmas)}
    if data.sightings is not None:
        out["spheres"] = _sphere_rows(state, data, sigmas)
        out["centres"] = _centre_rows(state, data)
        out["common"] = _common_rows(state, data)
    if data.robot is not None and data.group is not None:
        out["robot_position"], out["robot_rotation"] = _robot_rows(state, data, sigmas)
    if data.lens_covariance is not None:
        out["lens"] = _lens_rows(state, data)
    return out


def _project(cameras: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return points in their camera frames (O, 3), and derivatives (O, 3, 6) by the pose, (O, 3, 3) by the point."""
    R, t = cameras[:, :3, :3], cameras[:, :3, 3]
    v = points - t
    Rt = np.swapaxes(R, 1, 2)
    d_pose = np.concatenate([-Rt, Rt @ skew(v)], axis=2)
    return np.einsum("oij,oj->oi", Rt, v), d_pose, Rt


def _track_rows(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> Rows:
    tracks = data.tracks
    c, d_pose, d_point = _project(state.cameras[tracks.image], state.points[tracks.point])
    camera = state.camera
    f = np.array([camera.fx, camera.fy]) / sigmas.track_px
    measured = camera.normalise(tracks.pixels)
    residual = (c[:, :2] / c[:, 2:] - measured) * f
    d_image = np.zeros((len(c), 2, 3))
    d_image[:, 0, 0] = d_image[:, 1, 1] = 1 / c[:, 2]
    d_image[:, :, 2] = -c[:, :2] / c[:, 2:] ** 2
    d_image *= f[:, None]
    lens = None
    if data.lens_covariance is not None:
        lens = (lens_column(state, data), -_lens_derivative(camera, tracks.pixels, measured) * f[:, None])
    observed = _Observed(tracks.image, tracks.point, residual, d_image @ d_pose, d_image @ d_point, lens)
    return _rows(state, data, observed)


def _sphere_rows(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> Rows:
    s = data.sightings
    assert s is not None
    point = s.marker + len(data.tracks.points)
    light = data.light_unit_m * state.common[3:]
    c, d_pose, d_point = _project(state.cameras[s.image], state.points[point] + light)
    cones, e, lens = s.cones, s.cones.directions, None
    if data.lens_covariance is not None:
        assert data.calibrated is not None
        pixels = data.calibrated.project(cones.axes)
        plane = state.camera.normalise(pixels)
        axes = np.column_stack([plane, np.ones(len(plane))])
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        cones = dataclasses.replace(cones, axes=axes)
        # The focal length also changes the half angle, but by far less than its sigma.
        lift = np.zeros((len(c), 3, len(LENS)))
        lift[:, :2] = _lens_derivative(state.camera, pixels, plane) * axes[:, 2, None, None]
        lens = np.zeros((len(c), 3, len(LENS)))
        lens[:, :2] = -np.swapaxes(e, 1, 2) @ lift
    focal = 0.5 * (state.camera.fx + state.camera.fy)
    shift = np.zeros((len(c), 3, len(COMMON)))  # the common errors of the detector
    shift[:, :2, :2] = np.swapaxes(e[:, :2], 1, 2) * (cones.axes[:, 2] / focal)[:, None, None]
    shift[:, 2, 2] = cones.axes[:, 2] ** 2 / focal
    seen, d = cones.residuals(c, data.radius_m)
    residual = seen + shift @ state.common
    whitening = s.whitening / sigmas.sphere
    d = whitening @ d
    more = whitening @ shift
    more[:, :, 3:] = data.light_unit_m * (d @ d_point)
    if lens is not None:
        more = np.concatenate([more, whitening @ lens], axis=2)
    residual = np.einsum("sij,sj->si", whitening, residual)
    first = common_column(state)
    return _rows(state, data, _Observed(s.image, point, residual, d @ d_pose, d @ d_point, (first, more)))


def _lens_derivative(camera: CameraModel, pixels: Array, plane: Array) -> Array:
    """Return (O, 2, 4) derivative of the undistorted coordinates of fixed pixels by fx, fy, cx, cy."""
    out = np.empty((len(pixels), 2, len(LENS)))
    for k, name in enumerate(LENS):
        nudged = dataclasses.replace(camera, **{name: getattr(camera, name) + 0.5})
        out[:, :, k] = (nudged.normalise(pixels) - plane) / 0.5
    return out


@dataclass(frozen=True, slots=True)
class _Observed:
    """O observations of points, k numbers each, with their derivatives."""

    image: Index  # (O,)
    point: Index  # (O,)
    residual: Array  # (O, k)
    d_pose: Array  # (O, k, 6)
    d_point: Array  # (O, k, 3)
    more: tuple[int, Array] | None  # first column and derivatives (O, k, m) of further frame parameters


def _rows(state: BundleState, data: AdjustmentData, seen: _Observed) -> Rows:
    """Return the sparse rows from dense derivatives."""
    n_obs, k = seen.residual.shape
    row = np.arange(n_obs * k).reshape(n_obs, k, 1)
    columns = [np.broadcast_to(6 * seen.image[:, None, None] + np.arange(6), seen.d_pose.shape)]
    values = [seen.d_pose]
    if seen.more is not None:
        first, further = seen.more
        columns.append(np.broadcast_to(first + np.arange(further.shape[2]), further.shape))
        values.append(further)
    frame = np.concatenate(values, axis=2)
    return Rows(
        seen.residual.ravel(),
        _sparse(row, np.concatenate(columns, axis=2), frame, (n_obs * k, width(state, data))),
        _sparse(row, 3 * seen.point[:, None, None] + np.arange(3), seen.d_point, (n_obs * k, 3 * len(state.points))),
        k,
    )


def _sparse(row: NDArray[Any], column: NDArray[Any], values: NDArray[Any], shape: tuple[int, int]) -> csr_matrix:
    rows, columns = np.broadcast_to(row, values.shape), np.broadcast_to(column, values.shape)
    return coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape).tocsr()


def _centre_rows(state: BundleState, data: AdjustmentData) -> Rows:
    """Return the rows of the spheres' measured positions in the scan."""
    assert data.centres is not None
    assert data.centre_whitening is not None
    m, first = len(data.centres), len(data.tracks.points)
    residual = np.einsum("mij,mj->mi", data.centre_whitening, state.points[first:] - data.centres).ravel()
    row = np.arange(3 * m).reshape(m, 3, 1)
    column = 3 * (first + np.arange(m))[:, None, None] + np.arange(3)
    point = _sparse(row, column, data.centre_whitening, (3 * m, state.points.size))
    return Rows(residual, csr_matrix((3 * m, width(state, data))), point, 3)


def _common_rows(state: BundleState, data: AdjustmentData) -> Rows:
    """Return the rows of the prior of the errors that all outlines share."""
    assert data.common_sigma_px is not None
    count = len(COMMON)
    row, column = np.arange(count)[:, None], common_column(state) + np.arange(count)[:, None]
    frame = _sparse(row, column, 1 / data.common_sigma_px[:, None], (count, width(state, data)))
    return Rows(state.common / data.common_sigma_px, frame, csr_matrix((count, state.points.size)), 1)


def _robot_rows(state: BundleState, data: AdjustmentData, sigmas: Sigmas) -> tuple[Rows, Rows]:
    assert data.robot is not None
    assert data.group is not None
    image = np.nonzero(np.isfinite(data.robot).all(axis=(1, 2)))[0]
    base = data.group[image]
    B, M, T = state.bases[base], data.robot[image], state.cameras[image]
    arm = np.einsum("nij,nj->ni", B[:, :3, :3], M[:, :3, 3])
    position = T[:, :3, 3] - arm - B[:, :3, 3]
    turn = T[:, :3, :3] @ np.swapaxes(B[:, :3, :3] @ M[:, :3, :3], 1, 2)
    rotation = Rotation.from_matrix(turn).as_rotvec()
    one = np.broadcast_to(np.eye(3), (len(image), 3, 3))
    zero = np.zeros_like(one)
    out: list[Rows] = []
    for residual, d_camera, d_base, sigma in (
        (position, np.concatenate([one, zero], axis=2), np.concatenate([-one, skew(arm)], axis=2), sigmas.robot_m),
        (rotation, np.concatenate([zero, one], axis=2), np.concatenate([zero, -one], axis=2), sigmas.robot_rad),
    ):
        row = np.arange(3 * len(image)).reshape(-1, 3, 1)
        columns = np.concatenate(
            [
                np.broadcast_to(6 * image[:, None, None] + np.arange(6), d_camera.shape),
                np.broadcast_to(6 * (len(state.cameras) + base)[:, None, None] + np.arange(6), d_base.shape),
            ],
            axis=2,
        )
        frame = _sparse(
            row, columns, np.concatenate([d_camera, d_base], axis=2) / sigma, (3 * len(image), width(state, data))
        )
        out.append(Rows((residual / sigma).ravel(), frame, csr_matrix((3 * len(image), state.points.size)), 3))
    return out[0], out[1]


def _lens_rows(state: BundleState, data: AdjustmentData) -> Rows:
    """Return the rows of the lens calibration, as an observation of the lens."""
    assert data.calibrated is not None
    assert data.lens_covariance is not None
    whitening = whitening_of(data.lens_covariance)
    change = np.array([getattr(state.camera, name) - getattr(data.calibrated, name) for name in LENS])
    n, count = width(state, data), len(LENS)
    row, column = np.arange(count)[:, None], n - count + np.arange(count)[None, :]
    return Rows(
        whitening @ change,
        _sparse(row, column, whitening, (count, n)),
        csr_matrix((count, state.points.size)),
        count,
    )
