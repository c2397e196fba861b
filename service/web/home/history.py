"""Calibration and accuracy over time, for each camera, lens and arm: plots, tables, and a CSV to take away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.runs.history import FIGURES, Figure, HistoryRow, Instrument, by_instrument, history, history_csv
from service.web.page.charts import TimeChart, TimePoint, time_chart
from service.web.page.rendering import render
from service.web.security import requires
from service.web.site import CurrentSite

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
    rows = [row for row in history(site.store) if not rigs or row.run.basics.simulated == (rigs == "simulated")]
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
        TimePoint(row.at_utc, row.values[figure.key], f"run {row.run.basics.run_id}", row.run.basics.simulated)
        for row in rows
        if figure.key in row.values
    ]
    judged = [row.run.accuracy for row in rows if row.run.accuracy is not None]
    limit = judged[-1].most_mm if judged and figure.key == "mean_radial_error_mm" else None
    return time_chart(points, title=figure.name, unit=figure.unit, from_zero=figure.from_zero, limit=limit)
