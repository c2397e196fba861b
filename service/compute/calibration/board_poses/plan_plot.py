"""A picture of the taken and the suggested board poses, from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board_poses.plan import SuggestedPose
from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform, apply, inverse

_PANEL = 700  # px
_MARGIN = 50
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
    """PNG: cameras as pyramids around the board; taken ones grey, suggested ones in colour with their numbers."""
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
    _text(picture, text, (_MARGIN, 2 * _PANEL // 50))
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
    canvas = np.full((_PANEL, _PANEL, 3), 255, dtype=np.uint8)
    everything = np.vstack([board, *(T[None, :3, 3] for T in [*taken, *wanted])]) @ axes.T
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = (_PANEL - 3 * _MARGIN) / float(max((high - low).max(), 1e-6))
    centre = (low + high) / 2

    def at(points: Array) -> NDArray[np.int32]:
        return np.round(((points @ axes.T) - centre) * scale + _PANEL / 2).astype(np.int32)

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
    _text(canvas, title, (_MARGIN, _PANEL - 20))
    bar = round(0.1 * scale)
    cv2.line(canvas, (_PANEL - _MARGIN - bar, _PANEL - 25), (_PANEL - _MARGIN, _PANEL - 25), _INK, 2)
    _text(canvas, "10 cm", (_PANEL - _MARGIN - bar, _PANEL - 32))
    return canvas


def _frustum(T: Transform, camera: CameraModel) -> Array:
    """(5, 3) camera centre and the four image corners, the top edge first."""
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
