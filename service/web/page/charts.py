"""Small charts as coordinates for SVG, which calibration/templates/charts.html.j2 draws in the theme's ink."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

WIDTH = 640.0
LEVELS = 8  # shades of a heat map
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 14.0, 12.0, 46.0


@dataclass(frozen=True, slots=True)
class Tick:
    """A mark on an axis."""

    at: float
    text: str


@dataclass(frozen=True, slots=True)
class HeatMapCell:
    """A cell of a heat map; `text` is "" where there is no room."""

    x: float
    y: float
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class HeatMap:
    """Values over the image."""

    title: str
    unit: str
    height: float
    cell_width: float
    cell_height: float
    cells: tuple[HeatMapCell, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    scale: tuple[str, ...]  # lower end of each level, then the highest value
    font: float


@dataclass(frozen=True, slots=True)
class Arrow:
    """An arrow from one place to another."""

    x1: float
    y1: float
    x2: float
    y2: float


@dataclass(frozen=True, slots=True)
class VectorField:
    """Vectors over the image; `bar` is the length of `bar_text`."""

    title: str
    height: float
    arrows: tuple[Arrow, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    bar: float
    bar_text: str


@dataclass(frozen=True, slots=True)
class ChartPoint:
    """The value of one series for one name."""

    x: float
    y: float
    series: int


@dataclass(frozen=True, slots=True)
class DotPlot:
    """Values of several series for each name, along the x axis; the series differ in shape."""

    title: str
    height: float
    marks: tuple[ChartPoint, ...]
    series: tuple[str, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    limit: float | None  # y of it
    limit_text: str


def heat_map(
    values: Sequence[Sequence[float]],
    image_px: tuple[int, int],
    *,
    title: str,
    unit: str = "",
    digits: int = 0,
    logarithmic: bool = False,
    every: int = 1,
) -> HeatMap:
    """Draw values (rows, columns) over an image of a width and height in pixels.

    Args:
        digits: digits after the point of the numbers in the cells.
        logarithmic: shades go by the logarithm; for values above zero that span decades.
        every: write the number in one of this many cells, along rows and columns.
    """
    rows, columns = len(values), len(values[0])
    width = WIDTH - _LEFT - _RIGHT
    inner = width * image_px[1] / image_px[0]
    w, h = width / columns, inner / rows
    flat = [v for row in values for v in row]
    low, high = min(flat), max(flat)

    def share(value: float) -> float:
        if high <= low:
            return 0.0
        if logarithmic and low > 0:
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)

    cells: list[HeatMapCell] = []
    for r, row in enumerate(values):
        for c, value in enumerate(row):
            level = min(LEVELS - 1, int(LEVELS * share(value)))
            written = r % every == every // 2 and c % every == every // 2
            text = f"{value:.{digits}f}" if written else ""
            cells.append(HeatMapCell(round(_LEFT + c * w, 2), round(_TOP + r * h, 2), level, text))
    edges = [low * (high / low) ** (k / LEVELS) if logarithmic and low > 0 else low + (high - low) * k / LEVELS
             for k in range(LEVELS + 1)]  # fmt: skip
    return HeatMap(
        title, unit, round(inner + _TOP + _BOTTOM, 1), round(w, 2), round(h, 2), tuple(cells),
        *_pixel_ticks(image_px, inner), tuple(f"{edge:.2g}" if digits else f"{edge:.0f}" for edge in edges),
        round(min(17.0, 0.42 * every * w / max(1, digits + 1) + 4), 1),
    )  # fmt: skip


def vector_field(
    vectors: Sequence[Sequence[Sequence[float]]],
    counts: Sequence[Sequence[int]],
    image_px: tuple[int, int],
    *,
    title: str,
    least: int = 5,
) -> VectorField:
    """Return vectors (rows, columns, 2) in px, scaled so that the longest fills a cell, without cells of few."""
    rows, columns = len(vectors), len(vectors[0])
    width = WIDTH - _LEFT - _RIGHT
    inner = width * image_px[1] / image_px[0]
    w, h = width / columns, inner / rows
    kept = [(r, c, *vectors[r][c]) for r in range(rows) for c in range(columns) if counts[r][c] >= least]
    longest = max((math.hypot(x, y) for _, _, x, y in kept), default=0.0) or 1.0
    scale = 0.9 * min(w, h) / longest
    arrows = tuple(
        Arrow(
            *(round(v, 1) for v in (_LEFT + (c + 0.5) * w, _TOP + (r + 0.5) * h)),
            *(round(v, 1) for v in (_LEFT + (c + 0.5) * w + scale * x, _TOP + (r + 0.5) * h + scale * y)),
        )
        for r, c, x, y in kept
    )
    bar, height = _nice(longest), round(inner + _TOP + _BOTTOM, 1)
    return VectorField(
        title, height, arrows, *_pixel_ticks(image_px, inner), round(bar * scale, 1), f"{bar:g} px"
    )  # fmt: skip


def dots(
    names: Sequence[str],
    series: Sequence[tuple[str, Sequence[float | None]]],
    *,
    title: str,
    limit: float | None = None,
    limit_text: str = "",
) -> DotPlot:
    """Return a dot plot with one mark for each name and series. A limit far above all values is named, not drawn."""
    height = 300.0
    inner = height - _TOP - _BOTTOM
    known = [v for _, values in series for v in values if v is not None]
    top = max(known, default=1.0) * 1.08 or 1.0
    drawn = limit is not None and limit <= 3 * top
    if limit is not None and drawn:
        top = max(top, 1.1 * limit)
    step = (WIDTH - _LEFT - _RIGHT) / max(len(names), 1)

    def y(value: float) -> float:
        return round(_TOP + inner * (1 - value / top), 1)

    marks = [
        ChartPoint(round(_LEFT + (i + 0.5) * step, 1), y(value), s)
        for s, (_, values) in enumerate(series)
        for i, value in enumerate(values)
        if value is not None
    ]
    each = max(1, math.ceil(len(names) / 9))
    x_ticks = tuple(Tick(round(_LEFT + (i + 0.5) * step, 1), n) for i, n in enumerate(names) if i % each == 0)
    spacing = _nice(top / 4)
    y_ticks = tuple(Tick(y(k * spacing), f"{k * spacing:g}") for k in range(int(top / spacing) + 1))
    at = y(limit) if limit is not None and drawn else None
    return DotPlot(title, height, tuple(marks), tuple(n for n, _ in series), x_ticks, y_ticks, at, limit_text)


def _pixel_ticks(image_px: tuple[int, int], inner: float) -> tuple[tuple[Tick, ...], tuple[Tick, ...]]:
    width = WIDTH - _LEFT - _RIGHT
    spacing = _nice(image_px[0] / 5)
    across = range(0, image_px[0] + 1, int(spacing))
    down = range(0, image_px[1] + 1, int(spacing))
    return (
        tuple(Tick(round(_LEFT + width * v / image_px[0], 1), str(v)) for v in across),
        tuple(Tick(round(_TOP + inner * v / image_px[1], 1), str(v)) for v in down),
    )


def _nice(value: float) -> float:
    """Return the largest of 1, 2, 5 × 10ⁿ that is not above a value."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (5, 2, 1) if k * power <= value * 1.0000001)
