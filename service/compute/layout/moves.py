"""Suggests which sphere to move so that the spheres can be distinguished, and shows the move to a person."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.layout.ambiguity import (
    REQUIRED_DEPTH_M,
    REQUIRED_MARGIN_M,
    REQUIRED_MARGIN_OF_FIVE_M,
    check_layout,
    confusions,
    distances,
    misfits,
    similar,
)
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply
from service.core.units import mm

_STEPS_M = (0.02, 0.04)  # tried shifts along the table
_HEIGHTS_M = (-0.02, 0.0, 0.02)
_SPHERES_TRIED = 2
_MOST_MOVES = 5
_LOOKED_AT = 3  # most promising of all tried moves, which are rated in full
_CLEARANCE_RADII = 3.0  # between centres
_AMPLE = 2.0  # times the required margin: a larger margin does not make a move better
_PLACING_M = 0.004  # how inaccurately a person places a sphere
_OUTWARDS = 1.06  # of the outermost sphere's distance from the middle: beyond, the table may end


@dataclass(frozen=True, slots=True)
class Move:
    """A suggested move of one sphere.

    Attributes:
        sphere: its index.
        by_m: (3,) shift in the centres' frame.
        margin_m: margin of the layout after this move and those before it.
    """

    sphere: int
    by_m: Array
    margin_m: float


def innermost(centres_m: Array, count: int) -> frozenset[int]:
    """Return the `count` spheres nearest to the layout's middle: the control spheres on the specimen."""
    _, _, axes = np.linalg.svd(centres_m - centres_m.mean(axis=0), full_matrices=False)
    flat = (centres_m - centres_m.mean(axis=0)) @ axes[:2].T
    return frozenset(int(i) for i in np.argsort(np.linalg.norm(flat, axis=1), kind="stable")[:count])


def suggest_moves(
    centres_m: Array,
    *,
    up: Array,
    radius_m: float = 0.015,
    fixed: Collection[int] = (),
    required_margin_m: float = REQUIRED_MARGIN_M,
) -> tuple[Move, ...]:
    """Suggest successive moves until no assignment can be confused; each is the one that leaves the largest margin.

    The margin of a move is the least over all places where a person following the advice may put the sphere.

    Args:
        centres_m: (N, 3) the spheres' centres.
        up: (3,) unit vector away from the table, in the centres' frame.
        radius_m: radius of the spheres; moves keep them apart.
        fixed: spheres that cannot be moved.
        required_margin_m: required margin of four spheres.

    Raises:
        ComputeError: no single move improves the layout.
    """
    placed = np.array(centres_m, dtype=np.float64)
    chosen: list[Move] = []
    now = _rating(placed, required_margin_m)
    while now < 1.0 and len(chosen) < _MOST_MOVES:
        trials: list[tuple[float, int, Array]] = []
        for sphere in _involved(placed, fixed, required_margin_m):
            for by in _directions(up):
                trial = _shift(placed, sphere, by)
                if _fits(placed, trial, sphere, up, radius_m):
                    trials.append((_quick_rating(trial, required_margin_m), sphere, by))
        trials.sort(key=lambda entry: -entry[0])
        rated = [
            (
                min(_rating(at, required_margin_m) for at in _around(_shift(placed, sphere, by), sphere)),
                sphere,
                by,
            )
            for _, sphere, by in trials[:_LOOKED_AT]
        ]
        best = max(rated, key=lambda entry: entry[0], default=None)
        if best is None or best[0] <= now + 1e-3:
            break
        now, sphere, by = best
        placed = _shift(placed, sphere, by)
        chosen.append(Move(sphere, by, check_layout(placed, radius_m=radius_m).margin_m))
    if not chosen:
        raise ComputeError(
            "no single sphere's move makes this layout better", remedy="Place the spheres again, less regularly"
        )
    return tuple(chosen)


def _shift(centres: Array, sphere: int, by: Array) -> Array:
    moved = centres.copy()
    moved[sphere] += by
    return moved


def _quick_rating(centres: Array, required: float) -> float:
    """Return the margin over the required one, at most _AMPLE, minus one for each confusable assignment."""
    misfit = misfits(centres, *similar(distances(centres), 2 * np.sqrt(2.0) * _AMPLE * required))
    least = float(misfit.min(initial=_AMPLE * required)) / required
    return least - int(np.count_nonzero(misfit < required))


def _rating(centres: Array, required: float) -> float:
    """Return the least ratio of a layout's numbers to their required values, at most _AMPLE, less one per shortfall.

    So among several insufficient moves, the best is the one that leaves the fewest confusable assignments.
    """
    quick = _quick_rating(centres, required)
    if quick < 1:
        return quick
    report = check_layout(centres, required_margin_m=required)
    parts = [report.margin_of_five.value_m / REQUIRED_MARGIN_OF_FIVE_M, report.depth.value_m / REQUIRED_DEPTH_M]
    return min(quick, *parts) - sum(part < 1 for part in parts)


def _around(trial: Array, sphere: int) -> list[Array]:
    """Return the layout itself and variants with the sphere slightly displaced."""
    offsets = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * _PLACING_M
    return [_shift(trial, sphere, offset) for offset in offsets]


def _involved(centres: Array, fixed: Collection[int], required: float) -> list[int]:
    """Return the movable spheres that are most often mistaken for others."""
    found = confusions(centres, beyond_m=2 * required)
    moved = found.seen != found.taken
    count = np.bincount(
        found.seen[moved], weights=1.0 / (found.misfit[np.nonzero(moved)[0]] + 1e-5), minlength=len(centres)
    )
    return [int(i) for i in np.argsort(-count, kind="stable") if i not in fixed][:_SPHERES_TRIED]


def _directions(up: Array) -> list[Array]:
    """Return the shifts along the table combined with height changes, the short ones first."""
    first = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    turns = np.arange(6) * (np.pi / 3)
    return [
        length * (np.cos(t) * first + np.sin(t) * second) + height * up
        for length in _STEPS_M
        for height in _HEIGHTS_M
        for t in turns
    ]


def _fits(placed: Array, trial: Array, sphere: int, up: Array, radius_m: float) -> bool:
    """Return whether a sphere fits there: clear of the others, over the table, within their range of heights."""
    others = np.delete(distances(trial)[sphere], sphere)
    middle = placed.mean(axis=0)
    flat = placed - middle - np.outer((placed - middle) @ up, up)
    away = trial[sphere] - middle
    height = placed @ up
    return bool(
        others.min() >= _CLEARANCE_RADII * radius_m
        and np.linalg.norm(away - (away @ up) * up) <= _OUTWARDS * np.linalg.norm(flat, axis=1).max()
        and height.min() - 0.005 <= trial[sphere] @ up <= height.max() + 0.01
    )


_EDGES = ("right edge", "lower right corner", "lower edge", "lower left corner", "left edge", "upper left corner",
          "upper edge", "upper right corner")  # fmt: skip
_COLUMNS, _ROWS = ("left", "middle", "right"), ("top", "middle", "bottom")
_SAME_HEIGHT_M = 0.005


@dataclass(frozen=True, slots=True)
class PhotographedMove:
    """A move in a photograph.

    Attributes:
        words: text that says what to do.
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
    """Show the move in a photograph taken with `camera`.

    Args:
        move: the move in the centres' frame.
        centres_m: (N, 3) centres before the move.
        up: (3,) unit vector away from the table, in the centres' frame.
        T_photo_centres: maps that frame to the camera's.
        camera: the photograph's camera.
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
