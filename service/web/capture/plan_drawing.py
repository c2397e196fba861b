"""The viewpoints of a station seen from above, as coordinates for a drawing: the robot's side is at the bottom."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from service.web.capture.view import StepViewpoint, ViewState
from service.web.record.planned_poses import StationPlan, Vector

WIDTH = 640.0  # of the drawing; its height follows from what is on it
_MARGIN = 62.0
_TICK = 30.0  # length of the line that shows where a camera looks
_MOST_LABELS = 40
_MOST_SYMBOLS = 400  # beyond this, viewpoints that would overlap are drawn as one
_CELL = 6.0  # edge of the square within which viewpoints overlap
# Which of them is drawn: those that need attention come first.
_FIRST: Sequence[ViewState] = ("failed", "again", "unused", "departs", "left_out", "skipped", "open", "done", "next")


@dataclass(frozen=True, slots=True)
class Symbol:
    """A viewpoint on the drawing."""

    name: str
    label: str  # short, "" where there is no room
    state: ViewState
    x: float
    y: float
    tip_x: float  # tip of the line towards what it looks at
    tip_y: float


@dataclass(frozen=True, slots=True)
class PlanDrawing:
    """One station from above, in units of the drawing.

    Attributes:
        specimen: left, top, width, height.
        bar: length of 100 mm.
        robot: the place of its base; None when it is outside of the drawing (below it).
    """

    station: str
    merged: bool  # some symbols stand for several viewpoints
    width: float
    height: float
    symbols: tuple[Symbol, ...]
    specimen: tuple[float, float, float, float]
    bar: float
    robot: tuple[float, float] | None


def plan_drawing(station: StationPlan, views: Sequence[StepViewpoint], chosen: str = "") -> PlanDrawing | None:
    """Return the drawing; None without a viewpoint whose position is known. `chosen` is always drawn."""
    placed = [(v, v.position_m, v.looks) for v in views if v.position_m is not None and v.looks is not None]
    if not placed:
        return None
    layout = station.layout
    points = [_above(position, layout.scene_centre_m, layout.approach) for _, position, _ in placed]
    deep, across = station.specimen_m
    xs = [x for x, _ in points] + [-across / 2, across / 2]
    ys = [y for _, y in points] + [-deep / 2, deep / 2]
    left, right, top, bottom = min(xs), max(xs), min(ys), max(ys)
    scale = min((WIDTH - 2 * _MARGIN) / max(right - left, 0.1), 600.0 / max(bottom - top, 0.1))
    shift = (WIDTH - scale * (right - left)) / 2
    height = scale * (bottom - top) + 2 * _MARGIN

    def at(x: float, y: float) -> tuple[float, float]:
        return round(shift + scale * (x - left), 1), round(_MARGIN + scale * (y - top), 1)

    every: list[Symbol] = []
    for (view, _, looks), point in zip(placed, points, strict=True):
        x, y = at(*point)
        dx, dy = _above(looks, (0.0, 0.0, 0.0), layout.approach)
        length = math.hypot(dx, dy)
        reach = 0.0 if length < 0.05 else _TICK / length * min(1.0, length / 0.3)
        label = _short(view.name) if len(placed) <= _MOST_LABELS else ""
        every.append(Symbol(view.name, label, view.state, x, y, round(x + reach * dx, 1), round(y + reach * dy, 1)))
    symbols = every if len(every) <= _MOST_SYMBOLS else _apart(every, chosen)
    corner, far = at(-across / 2, -deep / 2), at(across / 2, deep / 2)
    base = at(*_above((0.0, 0.0, 0.0), layout.scene_centre_m, layout.approach))
    inside = 0 <= base[0] <= WIDTH and 0 <= base[1] <= height
    return PlanDrawing(
        station=layout.name,
        merged=len(symbols) < len(every),
        width=WIDTH,
        height=round(height, 1),
        symbols=tuple(symbols),
        specimen=(corner[0], corner[1], round(far[0] - corner[0], 1), round(far[1] - corner[1], 1)),
        bar=round(0.1 * scale, 1),
        robot=base if inside else None,
    )


def _apart(symbols: Sequence[Symbol], chosen: str) -> list[Symbol]:
    """Return one of the viewpoints that would overlap each other, and always the chosen and the next viewpoint."""
    wanted = [symbol for symbol in symbols if symbol.name == chosen or symbol.state == "next"]
    kept: dict[tuple[int, int], Symbol] = {}
    for symbol in sorted(symbols, key=lambda s: _FIRST.index(s.state)):
        kept.setdefault((int(symbol.x // _CELL), int(symbol.y // _CELL)), symbol)
    return [*(symbol for symbol in kept.values() if symbol not in wanted), *wanted]


def _short(name: str) -> str:
    """Shorten a name: v1_003 → 3; a name without a number stays."""
    number = re.search(r"(\d+)$", name)
    return number.group(1).lstrip("0") if number and not re.search(r"t\d+[+-]\d+$", name) else name


def _above(point: Vector, origin: Vector, approach: Vector) -> tuple[float, float]:
    """Return metres to the right and down the page of a point seen from above, the robot below."""
    x, y = point[0] - origin[0], point[1] - origin[1]
    side = (-approach[1], approach[0])  # up × approach
    return x * side[0] + y * side[1], x * approach[0] + y * approach[1]
