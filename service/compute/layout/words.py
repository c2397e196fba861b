"""A sphere's move for a person at the table: in words, and as an arrow in a photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.layout.sphere_moves import Move
from service.core.geometry import Array, Transform, apply
from service.core.units import mm

_EDGES = ("right edge", "lower right corner", "lower edge", "lower left corner", "left edge", "upper left corner",
          "upper edge", "upper right corner")  # fmt: skip
_COLUMNS, _ROWS = ("left", "middle", "right"), ("top", "middle", "bottom")
_SAME_HEIGHT_M = 0.005


@dataclass(frozen=True, slots=True)
class PhotographedMove:
    """A move in a photograph.

    Attributes:
        words: what to do.
        from_px: (2,) the sphere's position in the image as captured.
        to_px: (2,) its position after the move along the table, before the change of height.
        higher_m: change of height.
    """

    words: str
    from_px: Array
    to_px: Array
    higher_m: float


def show_move(
    move: Move, centres_m: Array, up: Array, T_photo_centres: Transform, camera: CameraModel, limit_m: float
) -> PhotographedMove:
    """The move as seen in a photograph taken with `camera`.

    Args:
        move: in the centres' frame.
        centres_m: (N, 3) before the move.
        up: (3,) unit vector away from the table, in the centres' frame.
        T_photo_centres: maps that frame to the camera's.
        camera: of the photograph.
        limit_m: required margin.
    """
    higher = float(move.by_m @ up)
    along = move.by_m - higher * up
    place = centres_m[move.sphere]
    start, end = camera.project(apply(T_photo_centres, np.array([place, place + along])))
    distance_cm = 100 * float(np.linalg.norm(along))
    parts: list[str] = []
    if distance_cm > 0.5:
        turn = np.arctan2(end[1] - start[1], end[0] - start[0])
        edge = _EDGES[int(np.round(turn / (np.pi / 4))) % 8]
        parts.append(f"by {distance_cm:.0f} cm towards the {edge} of the photograph")
    if abs(higher) > _SAME_HEIGHT_M:
        parts.append(f"{abs(100 * higher):.0f} cm {'higher' if higher > 0 else 'lower'}")
    column = _COLUMNS[int(np.clip(3 * start[0] / camera.width, 0, 2))]
    row = _ROWS[int(np.clip(3 * start[1] / camera.height, 0, 2))]
    where = "in the middle" if column == row == "middle" else f"at the {row} {column}".replace(" middle", "")
    words = (
        f"Move sphere {move.sphere}, {where} of the photograph, {' and '.join(parts)}; the margin is then predicted "
        f"to be {mm(move.margin_m):.1f} mm ({mm(limit_m):.1f} mm are needed)"
    )
    return PhotographedMove(words, start, end, higher)
