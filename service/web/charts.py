"""Small charts as coordinates for SVG, which templates/page/charts.html.j2 draws in the theme's ink."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

WIDTH = 640.0
LEVELS = 8  # shades of a heat map
_LEFT, _RIGHT, _TOP, _BOTTOM = 58.0, 14.0, 12.0, 46.0


@dataclass(frozen=True, slots=True)
class Tick:
    """A mark on an axis."""

    at: float
    text: str


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart: its title, its height, and the marks on its axes."""

    title: str
    height: float
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]


@dataclass(frozen=True, slots=True)
class HeatMapCell:
    """A cell of a heat map; `text` is "" where there is no room."""

    x: float
    y: float
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class HeatMap(Chart):
    """Values over the image."""

    unit: str
    cell_width: float
    cell_height: float
    cells: tuple[HeatMapCell, ...]
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
class VectorField(Chart):
    """Vectors over the image; `bar` is the length of `bar_text`."""

    arrows: tuple[Arrow, ...]
    bar: float
    bar_text: str


@dataclass(frozen=True, slots=True)
class ChartPoint:
    """The value of one series for one name."""

    x: float
    y: float
    series: int


@dataclass(frozen=True, slots=True)
class DotPlot(Chart):
    """Values of several series for each name, along the x axis; the series differ in shape."""

    marks: tuple[ChartPoint, ...]
    series: tuple[str, ...]
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
        title, round(inner + _TOP + _BOTTOM, 1), *_pixel_ticks(image_px, inner), unit, round(w, 2), round(h, 2),
        tuple(cells), tuple(f"{edge:.2g}" if digits else f"{edge:.0f}" for edge in edges),
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
    return VectorField(title, height, *_pixel_ticks(image_px, inner), arrows, round(bar * scale, 1), f"{bar:g} px")


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
    return DotPlot(title, height, x_ticks, y_ticks, tuple(marks), tuple(n for n, _ in series), at, limit_text)


def _pixel_ticks(image_px: tuple[int, int], inner: float) -> tuple[tuple[Tick, ...], tuple[Tick, ...]]:
    width = WIDTH - _LEFT - _RIGHT
    spacing = _nice(image_px[0] / 5)
    across = range(0, image_px[0] + 1, int(spacing))
    down = range(0, image_px[1] + 1, int(spacing))
    return (
        tuple(Tick(round(_LEFT + width * v / image_px[0], 1), str(v)) for v in across),
        tuple(Tick(round(_TOP + inner * v / image_px[1], 1), str(v)) for v in down),
    )


def _nice(value: float, *, above: bool = False) -> float:
    """Return the largest of 1, 2, 5 × 10ⁿ that is not above a value or, with `above`, the smallest not below it."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    if above:
        return next(k * power for k in (1, 2, 5, 10) if k * power >= value * 0.9999999)
    return next(k * power for k in (5, 2, 1) if k * power <= value * 1.0000001)


# --- over time ------------------------------------------------------------------------------------------------------

_TIME_LEFT, _TIME_RIGHT, _TIME_TOP, _TIME_BOTTOM = 92.0, 20.0, 14.0, 44.0
_HEIGHT = 300.0
_DAY_S = 86400.0


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A value at a time; `of` says whose."""

    at_utc: str
    value: float
    of: str
    simulated: bool = False


@dataclass(frozen=True, slots=True)
class TimeMark:
    """A point in the drawing; `text` for who points at it."""

    x: float
    y: float
    simulated: bool
    text: str


@dataclass(frozen=True, slots=True)
class TimeChart(Chart):
    """Points over time, a line through those of real rigs and one through the simulated, and the newest limit."""

    summary: str  # the same in a sentence
    marks: tuple[TimeMark, ...]
    lines: tuple[str, ...]  # paths
    limit: float | None  # y of it
    limit_text: str
    left: float = _TIME_LEFT
    right: float = WIDTH - _TIME_RIGHT
    bottom: float = _HEIGHT - _TIME_BOTTOM


def time_chart(
    points: Sequence[TimePoint], *, title: str, unit: str, from_zero: bool = True, limit: float | None = None
) -> TimeChart | None:
    """Return a chart of points in order of time; None if there are no points.

    Args:
        points: the points, oldest first.
        title: the chart's title.
        unit: the values' unit.
        from_zero: the axis begins at zero; otherwise it spans the values.
        limit: the largest value that the protocol allows; None if it sets no limit.
    """
    if not points:
        return None
    times = [datetime.fromisoformat(point.at_utc).timestamp() for point in points]
    low, high = _range([p.value for p in points], limit, from_zero=from_zero)
    first, last = min(times), max(times)
    margin = max(0.04 * (last - first), 1800.0)  # a single point stands in the middle
    first, last = first - margin, last + margin

    def x(at_s: float) -> float:
        return round(_TIME_LEFT + (WIDTH - _TIME_LEFT - _TIME_RIGHT) * (at_s - first) / (last - first), 1)

    def y(value: float) -> float:
        return round(_TIME_TOP + (_HEIGHT - _TIME_TOP - _TIME_BOTTOM) * (high - value) / (high - low), 1)

    marks = tuple(
        TimeMark(x(at_s), y(p.value), p.simulated, _mark_label(p, unit))
        for at_s, p in zip(times, points, strict=True)
    )
    newest = points[-1].value
    summary = f"{len(points)} value{'' if len(points) == 1 else 's'}, the newest {newest:.5g} {unit}".rstrip()
    drawn = limit is not None and low <= limit <= high
    spacing = _nice((high - low) / 4, above=True)
    count = range(math.ceil(low / spacing - 1e-9), math.floor(high / spacing + 1e-9) + 1)
    digits = max(0, -math.floor(math.log10(spacing)))
    return TimeChart(
        title=f"{title} ({unit})" if unit else title,
        summary=summary,
        height=_HEIGHT,
        marks=marks,
        lines=_lines(marks),
        x_ticks=tuple(Tick(x(at_s), label) for at_s, label in _days(first, last)),
        y_ticks=tuple(Tick(y(k * spacing), f"{k * spacing:.{digits}f}") for k in count),
        limit=y(limit) if drawn and limit is not None else None,
        limit_text="" if limit is None else f"limit of the newest run {limit:g}",
    )


def _mark_label(point: TimePoint, unit: str) -> str:
    at = point.at_utc[:16].replace("T", " ")
    return f"{point.value:.5g} {unit}, {at} UTC, {point.of}" + (", simulated" if point.simulated else "")


def _lines(marks: Sequence[TimeMark]) -> tuple[str, ...]:
    """Return SVG paths through the marks of real rigs and of simulated ones, where there is more than one."""
    groups = ([mark for mark in marks if mark.simulated == simulated] for simulated in (False, True))
    return tuple("M" + "L".join(f"{mark.x} {mark.y}" for mark in group) for group in groups if len(group) > 1)


def _range(values: Sequence[float], limit: float | None, *, from_zero: bool) -> tuple[float, float]:
    low, high = min(values), max(values)
    if from_zero and low >= 0:
        near = limit is not None and limit < 4 * high  # a far one would flatten the rest
        return 0.0, 1.1 * (max(high, limit) if limit is not None and near else high) or 1.0
    apart = high - low or 0.002 * abs(high) or 1.0
    return low - 0.25 * apart, high + 0.25 * apart


def _days(first: float, last: float) -> list[tuple[float, str]]:
    """Return up to five times on whole hours, days, or multiples of them, in UTC."""
    hours, days = (0.25, 1, 3, 6), (1, 2, 7, 14, 30, 91)
    steps = (*(3600.0 * k for k in hours), *(_DAY_S * k for k in days))
    step = next((s for s in steps if (last - first) / s <= 4), 365 * _DAY_S)
    at = [k * step for k in range(math.ceil(first / step), math.floor(last / step) + 1)]
    pattern = "%m-%d %H:%M" if step < _DAY_S else "%Y-%m-%d"
    return [(s, datetime.fromtimestamp(s, UTC).strftime(pattern)) for s in at[:5]]
