"""Calibration and accuracy over time, for each camera, lens and arm: plots, tables, and a CSV to take away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.runs.history import FIGURES, Figure, HistoryRow, Instrument, by_instrument, history, history_csv
from service.web.page.charts import WIDTH, Tick
from service.web.page.rendering import render
from service.web.security import requires
from service.web.site import CurrentSite

_LEFT, _RIGHT, _TOP, _BOTTOM = 92.0, 20.0, 14.0, 44.0
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
class TimeChart:
    """Points over time, a line through those of real rigs and one through the simulated, and the newest limit."""

    title: str
    summary: str  # the same in a sentence
    height: float
    marks: tuple[TimeMark, ...]
    lines: tuple[str, ...]  # paths
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    limit: float | None  # y of it
    limit_text: str
    left: float = _LEFT
    right: float = WIDTH - _RIGHT
    bottom: float = _HEIGHT - _BOTTOM


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
        return round(_LEFT + (WIDTH - _LEFT - _RIGHT) * (at_s - first) / (last - first), 1)

    def y(value: float) -> float:
        return round(_TOP + (_HEIGHT - _TOP - _BOTTOM) * (high - value) / (high - low), 1)

    marks = tuple(
        TimeMark(x(at_s), y(p.value), p.simulated, _mark_words(p, unit))
        for at_s, p in zip(times, points, strict=True)
    )
    newest = points[-1].value
    summary = f"{len(points)} value{'' if len(points) == 1 else 's'}, the newest {newest:.5g} {unit}".rstrip()
    drawn = limit is not None and low <= limit <= high
    spacing = _nice((high - low) / 4)
    count = range(math.ceil(low / spacing - 1e-9), math.floor(high / spacing + 1e-9) + 1)
    digits = max(0, -math.floor(math.log10(spacing)))
    return TimeChart(
        title=f"{title} ({unit})" if unit else title,
        summary=summary,
        height=_HEIGHT,
        marks=marks,
        lines=_lines(marks),
        x_ticks=tuple(Tick(x(at_s), words) for at_s, words in _days(first, last)),
        y_ticks=tuple(Tick(y(k * spacing), f"{k * spacing:.{digits}f}") for k in count),
        limit=y(limit) if drawn and limit is not None else None,
        limit_text="" if limit is None else f"limit of the newest run {limit:g}",
    )


def _mark_words(point: TimePoint, unit: str) -> str:
    at = point.at_utc[:16].replace("T", " ")
    return f"{point.value:.5g} {unit}, {at} UTC, {point.of}" + (", simulated" if point.simulated else "")


def _lines(marks: Sequence[TimeMark]) -> tuple[str, ...]:
    """Return SVG paths through the marks of real rigs and of simulated ones, where there is more than one."""
    groups = ([mark for mark in marks if mark.simulated == simulated] for simulated in (False, True))
    return tuple("M" + "L".join(f"{mark.x} {mark.y}" for mark in group) for group in groups if len(group) > 1)


def _range(values: Sequence[float], limit: float | None, *, from_zero: bool) -> tuple[float, float]:
    low, high = min(values), max(values)
    if from_zero and low >= 0:
        most = (
            max(high, limit) if limit is not None and limit < 4 * high else high
        )  # a far one would flatten the rest
        return 0.0, 1.1 * most or 1.0
    apart = high - low or 0.002 * abs(high) or 1.0
    return low - 0.25 * apart, high + 0.25 * apart


def _days(first: float, last: float) -> list[tuple[float, str]]:
    """Return up to five times on whole hours, days, or multiples of them, in UTC."""
    steps = (
        900.0,
        3600.0,
        3 * 3600.0,
        6 * 3600.0,
        _DAY_S,
        2 * _DAY_S,
        7 * _DAY_S,
        14 * _DAY_S,
        30 * _DAY_S,
        91 * _DAY_S,
    )
    step = next((s for s in steps if (last - first) / s <= 4), 365 * _DAY_S)
    at = [k * step for k in range(math.ceil(first / step), math.floor(last / step) + 1)]
    form = "%m-%d %H:%M" if step < _DAY_S else "%Y-%m-%d"
    return [(s, datetime.fromtimestamp(s, UTC).strftime(form)) for s in at[:5]]


def _nice(value: float) -> float:
    """Return the smallest of 1, 2, 5 × 10ⁿ that is not below a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= value * 0.9999999)


router = APIRouter(tags=["history"])
_READ = [Depends(requires("read"))]


@dataclass(frozen=True, slots=True)
class InstrumentHistory:
    """One instrument with its charts and the rows behind them."""

    instrument: Instrument
    figures: tuple[Figure, ...]
    charts: tuple[TimeChart, ...]
    rows: tuple[HistoryRow, ...]


@router.get("/history", name="history", dependencies=_READ)
def history_page(
    request: Request, site: CurrentSite, rigs: Annotated[str, Query(pattern="^(|real|simulated)$")] = ""
) -> HTMLResponse:
    """Show every instrument that took part in a run with figures; of all rigs, the real or the simulated ones."""
    rows = [row for row in history(site.store) if not rigs or row.run.simulated == (rigs == "simulated")]
    courses = [_course(instrument, mine) for instrument, mine in by_instrument(rows).items()]
    return render(request, "home/history.html.j2", courses=courses, rigs=rigs, count=len(rows))


@router.get("/history.csv", name="history_csv", dependencies=_READ)
def history_file(site: CurrentSite) -> Response:
    """Show all rows as CSV."""
    name = f"orthocapture-history-{site.store.clock.utc_now():%Y%m%d}.csv"
    return Response(
        history_csv(history(site.store)),
        media_type="text/csv; charset=utf-8",
        headers={"Content-Disposition": f'attachment; filename="{name}"'},
    )


def _course(instrument: Instrument, rows: Sequence[HistoryRow]) -> InstrumentHistory:
    figures = tuple(f for f in FIGURES if instrument.kind in f.of and any(f.key in row.values for row in rows))
    charts = (_chart(figure, rows) for figure in figures)
    return InstrumentHistory(instrument, figures, tuple(chart for chart in charts if chart is not None), tuple(rows))


def _chart(figure: Figure, rows: Sequence[HistoryRow]) -> TimeChart | None:
    points = [
        TimePoint(row.at_utc, row.values[figure.key], f"run {row.run.run_id}", row.run.simulated)
        for row in rows
        if figure.key in row.values
    ]
    judged = [row.run.accuracy for row in rows if row.run.accuracy is not None]
    limit = judged[-1].most_mm if judged and figure.key == "mean_radial_error_mm" else None
    return time_chart(points, title=figure.name, unit=figure.unit, from_zero=figure.from_zero, limit=limit)
