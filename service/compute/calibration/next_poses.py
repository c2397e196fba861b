"""Suggests and draws the next board poses: those that shrink the covariance of T_flange_camera most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.hand_eye import HandEyeAnswer
from service.compute.calibration.reprojection import linearise, projection_jacobian
from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform
from service.core.units import deg, metres, mm

_TILTS_DEG = (0.0, 12.0, 25.0, 38.0, 48.0)
_AZIMUTHS = 12
_ROLLS_DEG = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
_DISTANCES = (0.8, 1.0)  # times the median distance so far
_FREE_MARGIN = 0.02  # of the image's width, free of corners
_MOST_TRIED = 60  # of the best candidates, until one is reachable
_FLOOR_M, _FLOOR_RAD = 1e-5, 1e-5


@dataclass(frozen=True, slots=True)
class SuggestedPose:
    """A suggested board pose.

    Attributes:
        T_base_flange: target pose of the flange.
        T_base_camera: the camera's pose there.
        sigma_mm: predicted standard deviation of T_flange_camera's translation after this and all poses before it.
        sigma_deg: standard deviation of its rotation.
    """

    T_base_flange: Transform
    T_base_camera: Transform
    sigma_mm: float
    sigma_deg: float


def suggest_board_poses(
    answer: HandEyeAnswer,
    T_base_flange: Array,
    points_m: Array,
    camera: CameraModel,
    *,
    corner_sigma_px: float,
    count: int = 6,
    reachable: Callable[[Transform], bool] | None = None,
) -> tuple[SuggestedPose, ...]:
    """Choose poses by greedy A-optimality among arcs and rolls around the board, on the linearised weighted problem.

    The criterion is the mean square displacement that T_flange_camera's error causes at the board's distance.
    Candidates show the whole board.

    Args:
        answer: the calibration so far; its robot noise weights the poses.
        T_base_flange: (N, 4, 4) poses taken so far.
        points_m: (P, 3) the board's points.
        camera: the calibrated camera.
        corner_sigma_px: standard deviation of a corner.
        count: number of poses wanted.
        reachable: says if the arm can take a flange pose; called only for the best candidates.

    Returns:
        Up to `count` poses in the order of their gain; fewer if no others are reachable.

    Raises:
        DataError: no pose has been taken yet.
    """
    if len(T_base_flange) == 0:
        raise DataError("there is no board pose yet")
    X, B = answer.T_flange_camera, answer.T_base_board
    model = _Model.of(answer, points_m, camera, corner_sigma_px)
    candidates = _candidates(B, T_base_flange @ X, points_m, camera)
    flanges = candidates @ inverse(X)
    so_far, gains = model.information(T_base_flange).sum(axis=0), model.information(flanges)
    middle = apply(B, points_m.mean(axis=0))
    lever = float(np.median(np.linalg.norm((T_base_flange @ X)[:, :3, 3] - middle, axis=1)))
    open_ = list(range(len(flanges)))
    chosen: list[SuggestedPose] = []

    @cache
    def within_reach(candidate: int) -> bool:
        return reachable is None or reachable(flanges[candidate])

    while open_ and len(chosen) < count:
        covariance = _covariance_of(so_far + gains[open_])
        cost = np.trace(covariance[:, :3, :3], axis1=1, axis2=2)
        cost = cost + lever**2 * np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2)
        best = next((k for k in np.argsort(cost)[:_MOST_TRIED].tolist() if within_reach(open_[k])), None)
        if best is None:
            break
        pick = open_.pop(best)
        so_far = so_far + gains[pick]
        sigma_m, sigma_rad = (
            float(np.sqrt(np.trace(part))) for part in (covariance[best, :3, :3], covariance[best, 3:, 3:])
        )
        chosen.append(SuggestedPose(flanges[pick], candidates[pick], mm(sigma_m), deg(sigma_rad)))
    return tuple(chosen)


def _candidates(T_base_board: Transform, T_base_camera: Array, points_m: Array, camera: CameraModel) -> Array:
    """Return (C, 4, 4) camera poses around the board with the whole board in the image."""
    centre_board = points_m.mean(axis=0)
    eyes = (T_base_camera @ np.array([0.0, 0.0, 0.0, 1.0]))[:, :3]
    centre = T_base_board[:3, :3] @ centre_board + T_base_board[:3, 3]
    away = float(np.median(np.linalg.norm(eyes - centre, axis=1)))
    poses: list[Transform] = []
    for tilt in np.radians(_TILTS_DEG):
        azimuths = np.arange(_AZIMUTHS if tilt > 0 else 1) * 2 * np.pi / _AZIMUTHS
        for azimuth in azimuths:
            # The board's z points away from the camera.
            out = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
            for share in _DISTANCES:
                upright = look_at(centre_board + share * away * out, centre_board, np.array([0.0, -1.0, 0.0]))
                turns = [transform(Rotation.from_euler("z", roll, degrees=True), np.zeros(3)) for roll in _ROLLS_DEG]
                poses += [T_base_board @ upright @ turn for turn in turns]
    all_poses = np.array(poses)
    boards = np.array([inverse(T) @ T_base_board for T in all_poses])
    seen = np.einsum("nij,pj->npi", boards[:, :3, :3], points_m) + boards[:, None, :3, 3]
    pixels = camera.project(seen.reshape(-1, 3)).reshape(len(boards), -1, 2)
    margin = _FREE_MARGIN * camera.width
    inside = (pixels > margin) & (pixels < np.array([camera.width, camera.height]) - margin)
    return all_poses[inside.all(axis=(1, 2))]


@dataclass(frozen=True, slots=True)
class _Model:
    """The linearised measurement of a board pose.

    Attributes:
        T_flange_camera, T_base_board: the poses by the calibration so far.
        points_m: (P, 3) the board's points.
        camera: the calibrated camera.
        corner_sigma_px: standard deviation of a corner.
        robot_covariance: (6, 6) covariance of a flange pose, m² and rad².
    """

    T_flange_camera: Transform
    T_base_board: Transform
    points_m: Array
    camera: CameraModel
    corner_sigma_px: float
    robot_covariance: Array

    @classmethod
    def of(cls, answer: HandEyeAnswer, points_m: Array, camera: CameraModel, corner_sigma_px: float) -> _Model:
        """Build the model with the robot's noise from the calibration so far."""
        robot = np.diag(
            [max(metres(answer.robot_noise_mm or 0.0), _FLOOR_M) ** 2] * 3
            + [max(np.radians(answer.robot_noise_deg or 0.0), _FLOOR_RAD) ** 2] * 3
        )
        return cls(answer.T_flange_camera, answer.T_base_board, points_m, camera, corner_sigma_px, robot)

    def information(self, flanges: Array) -> Array:
        """Return (N, 12, 12) information of each pose (N, 4, 4) about T_flange_camera and T_base_board."""
        if len(flanges) == 0:
            return np.zeros((0, 12, 12))
        X, B = self.T_flange_camera, self.T_base_board
        boards = np.array([inverse(flange @ X) @ B for flange in flanges])
        _, J_px = projection_jacobian(self.points_m, boards, self.camera)
        rows = J_px.reshape(len(boards), -1, 6)
        normal = np.swapaxes(rows, 1, 2) @ rows
        scale = 1 / np.sqrt(np.einsum("nii->ni", normal))
        both = scale[:, :, None] * scale[:, None, :]
        covariance = np.linalg.inv(normal * both) * both * self.corner_sigma_px**2
        _, J, from_board = linearise(flanges, boards, X, B)
        V = self.robot_covariance + from_board @ covariance @ np.swapaxes(from_board, 1, 2)
        return np.swapaxes(J, 1, 2) @ np.linalg.solve(V, J)


def _covariance_of(information: Array) -> Array:
    """Return (C, 6, 6) covariance of T_flange_camera from joint information (C, 12, 12)."""
    scale = 1 / np.sqrt(np.einsum("nii->ni", information))
    both = scale[:, :, None] * scale[:, None, :]
    return (np.linalg.inv(information * both) * both)[:, :6, :6]


_PANEL_PX = 700  # px
_MARGIN_PX = 50
_TAKEN, _SUGGESTED, _BOARD, _INK = (150, 150, 150), (20, 90, 230), (60, 140, 60), (40, 40, 40)  # BGR
_LABEL = 14  # px; labels nearer than this are joined: poses often differ only in their roll
_DEPTH_M = 0.07  # of a camera's pyramid


def draw_board_plan(
    T_base_camera: Array,
    suggested: Sequence[SuggestedPose],
    T_base_board: Transform,
    points_m: Array,
    camera: CameraModel,
) -> bytes:
    """Draw a PNG of cameras as pyramids around the board; taken ones grey, suggested ones numbered in colour."""
    middle = points_m.mean(axis=0)
    lift = T_base_board.copy()
    lift[:3, 3] = apply(T_base_board, middle)
    to_board = inverse(lift)  # x, y along the board, z away from the cameras
    taken = [to_board @ T for T in T_base_camera]
    wanted = [to_board @ pose.T_base_camera for pose in suggested]
    outline = np.array([[x, y, 0.0] for x, y in _corners(points_m - middle)])
    panels = [
        _panel("from above", taken, wanted, outline, camera, np.array([[1.0, 0, 0], [0, 1.0, 0]])),
        _panel("from the side", taken, wanted, outline, camera, np.array([[1.0, 0, 0], [0, 0, 1.0]])),
    ]
    picture = np.hstack(panels)
    text = f"{len(taken)} taken (grey), {len(wanted)} suggested (red, in order)"
    _text(picture, text, (_MARGIN_PX, 2 * _PANEL_PX // 50))
    return cv2.imencode(".png", picture)[1].tobytes()


def _corners(points: Array) -> list[tuple[float, float]]:
    low, high = points.min(axis=0), points.max(axis=0)
    return [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]


def _panel(
    title: str,
    taken: Sequence[Transform],
    wanted: Sequence[Transform],
    board: Array,
    camera: CameraModel,
    axes: Array,
) -> NDArray[np.uint8]:
    canvas = np.full((_PANEL_PX, _PANEL_PX, 3), 255, dtype=np.uint8)
    everything = np.vstack([board, *(T[None, :3, 3] for T in [*taken, *wanted])]) @ axes.T
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = (_PANEL_PX - 3 * _MARGIN_PX) / float(max((high - low).max(), 1e-6))
    centre = (low + high) / 2

    def at(points: Array) -> NDArray[np.int32]:
        return np.round(((points @ axes.T) - centre) * scale + _PANEL_PX / 2).astype(np.int32)

    cv2.polylines(canvas, [at(board)], isClosed=True, color=_BOARD, thickness=3, lineType=cv2.LINE_AA)
    for T_board_camera in taken:
        _pyramid(canvas, at(_frustum(T_board_camera, camera)), _TAKEN, 1)
    labels: dict[tuple[int, int], str] = {}
    for number, T_board_camera in enumerate(wanted, start=1):
        corners = at(_frustum(T_board_camera, camera))
        _pyramid(canvas, corners, _SUGGESTED, 2)
        eye = (int(corners[0, 0]) + 8, int(corners[0, 1]) - 8)
        place = next((p for p in labels if max(abs(p[0] - eye[0]), abs(p[1] - eye[1])) < _LABEL), eye)
        labels[place] = f"{labels[place]}, {number}" if place in labels else str(number)
    for place, label in labels.items():
        _text(canvas, label, place, _SUGGESTED)
    _text(canvas, title, (_MARGIN_PX, _PANEL_PX - 20))
    bar = round(0.1 * scale)
    cv2.line(
        canvas, (_PANEL_PX - _MARGIN_PX - bar, _PANEL_PX - 25), (_PANEL_PX - _MARGIN_PX, _PANEL_PX - 25), _INK, 2
    )
    _text(canvas, "10 cm", (_PANEL_PX - _MARGIN_PX - bar, _PANEL_PX - 32))
    return canvas


def _frustum(T: Transform, camera: CameraModel) -> Array:
    """Return (5, 3) camera centre and the four image corners, the top edge first."""
    x, y = camera.width / camera.fx / 2, camera.height / camera.fy / 2
    rays = np.array([[0, 0, 0], [-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) * _DEPTH_M
    return apply(T, rays)


def _pyramid(canvas: NDArray[np.uint8], corners: NDArray[np.int32], colour: tuple[int, int, int], width: int) -> None:
    eye, frame = corners[0], corners[1:]
    cv2.polylines(canvas, [frame], isClosed=True, color=colour, thickness=width, lineType=cv2.LINE_AA)
    for corner in frame:
        cv2.line(canvas, (int(eye[0]), int(eye[1])), (int(corner[0]), int(corner[1])), colour, width, cv2.LINE_AA)
    top = [(int(x), int(y)) for x, y in frame[:2]]
    cv2.line(canvas, top[0], top[1], colour, width + 2, cv2.LINE_AA)  # marks the image's top


def _text(canvas: NDArray[np.uint8], text: str, at: tuple[int, int], colour: tuple[int, int, int] = _INK) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
