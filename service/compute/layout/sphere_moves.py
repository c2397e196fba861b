"""Which sphere of a layout to move, and where to, so that the spheres can be told from one another."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from service.compute.layout.ambiguity import (
    REQUIRED_DEPTH_M,
    REQUIRED_MARGIN_M,
    REQUIRED_MARGIN_OF_FIVE_M,
    check_layout,
    confusions,
    distances,
    similar,
)
from service.compute.layout.misfits import misfits
from service.core.errors import ComputeError
from service.core.geometry import Array

_STEPS_M = (0.02, 0.04)  # how far a sphere is tried elsewhere, along the table
_HEIGHTS_M = (-0.02, 0.0, 0.02)
_SPHERES_TRIED = 2
_MOST_MOVES = 5
_LOOKED_AT = 3  # of all moves tried, the most promising
_CLEARANCE_RADII = 3.0  # between centres
_AMPLE = 2.0  # times the required margin: more than this makes no move better
_PLACING_M = 0.004  # how far beside the advice a person places a sphere
_OUTWARDS = 1.06  # of the outermost sphere's distance from the middle: beyond, there may be no table


@dataclass(frozen=True, slots=True)
class Move:
    """A sphere that is better placed elsewhere.

    Attributes:
        sphere: its index.
        by_m: (3,) shift in the frame of the centres.
        margin_m: of the layout after this move and those before it.
    """

    sphere: int
    by_m: Array
    margin_m: float


def innermost(centres_m: Array, count: int) -> frozenset[int]:
    """The `count` spheres nearest to the layout's middle: control spheres, which the specimen carries."""
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
    """Moves, one after the other, until no assignment is confused; each one that which leaves most margin.

    The margin of a move is the least over the places to which a person who follows it may bring the sphere.

    Args:
        centres_m: (N, 3).
        up: (3,) unit vector away from the table, in the frame of the centres.
        radius_m: of the spheres; moves keep them apart.
        fixed: spheres that cannot be moved.
        required_margin_m: of four spheres.

    Raises:
        ComputeError: no single move makes it better.
    """
    placed = np.array(centres_m, dtype=np.float64)
    chosen: list[Move] = []
    now = _rating(placed, required_margin_m)
    while now < 1.0 and len(chosen) < _MOST_MOVES:
        trials: list[tuple[float, int, Array]] = []
        for sphere in _involved(placed, fixed, required_margin_m):
            for by in _directions(up):
                trial = _moved(placed, sphere, by)
                if _fits(placed, trial, sphere, up, radius_m):
                    trials.append((_quick_rating(trial, required_margin_m), sphere, by))
        trials.sort(key=lambda entry: -entry[0])
        rated = [
            (min(_rating(at, required_margin_m) for at in _around(_moved(placed, sphere, by), sphere)), sphere, by)
            for _, sphere, by in trials[:_LOOKED_AT]
        ]
        best = max(rated, key=lambda entry: entry[0], default=None)
        if best is None or best[0] <= now + 1e-3:
            break
        now, sphere, by = best
        placed = _moved(placed, sphere, by)
        chosen.append(Move(sphere, by, check_layout(placed, radius_m=radius_m).margin_m))
    if not chosen:
        raise ComputeError(
            "no single sphere's move makes this layout better", remedy="set the spheres up anew, less regularly"
        )
    return tuple(chosen)


def _moved(centres: Array, sphere: int, by: Array) -> Array:
    moved = centres.copy()
    moved[sphere] += by
    return moved


def _quick_rating(centres: Array, required: float) -> float:
    """The margin over what it must be, _AMPLE at most, less by one for each assignment that is confused."""
    misfit = misfits(centres, *similar(distances(centres), 2 * np.sqrt(2.0) * _AMPLE * required))
    least = float(misfit.min(initial=_AMPLE * required)) / required
    return least - int(np.count_nonzero(misfit < required))


def _rating(centres: Array, required: float) -> float:
    """The least of the layout's numbers over what each must reach, _AMPLE at most; less by one for each shortfall.

    So the best of several moves that do not suffice is the one that leaves fewest assignments confused.
    """
    quick = _quick_rating(centres, required)
    if quick < 1:
        return quick
    report = check_layout(centres, required_margin_m=required)
    parts = [report.margin_of_five.value_m / REQUIRED_MARGIN_OF_FIVE_M, report.depth.value_m / REQUIRED_DEPTH_M]
    return min(quick, *parts) - sum(part < 1 for part in parts)


def _around(trial: Array, sphere: int) -> list[Array]:
    """The layout, and those in which the sphere is a little beside its place."""
    offsets = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * _PLACING_M
    return [_moved(trial, sphere, offset) for offset in offsets]


def _involved(centres: Array, fixed: Collection[int], required: float) -> list[int]:
    """The spheres that are most often taken for others, those that can be moved."""
    found = confusions(centres, beyond_m=2 * required)
    moved = found.seen != found.taken
    count = np.bincount(
        found.seen[moved], weights=1.0 / (found.misfit[np.nonzero(moved)[0]] + 1e-5), minlength=len(centres)
    )
    return [int(i) for i in np.argsort(-count, kind="stable") if i not in fixed][:_SPHERES_TRIED]


def _directions(up: Array) -> list[Array]:
    """Shifts along the table and up or down, the short ones first."""
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
    """Whether a sphere can be there: clear of the others, over the table, neither higher nor lower than these."""
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
