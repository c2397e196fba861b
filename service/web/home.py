"""The first pages: runs under way and recorded, protocols to start or print, comparison, figures over time."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Form, Path, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import Field

from service.audit.comparison import ComparedRun, compare_runs
from service.audit.filters import RunSearch
from service.audit.runs import (
    FIGURES,
    RESULT_WORDS,
    Figure,
    HistoryRow,
    Instrument,
    by_instrument,
    find_runs,
    history,
    history_csv,
)
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.measure_names import measure_name
from service.core.protocol import LoadedProtocol, Protocol, irreversible_warning, load_protocol
from service.core.records.entered import LINE_CHARACTERS, TEXT_CHARACTERS, RunAbout
from service.core.run.state import lost_arms
from service.monitor.snapshot import read_snapshot
from service.people.approvals import ProtocolStanding, difference, standing_of
from service.steps import params_models
from service.store.disk_space import forecast_of
from service.store.records import RunRow
from service.web.charts import TimeChart, TimePoint, time_chart
from service.web.rendering import render
from service.web.robot_banner import robot_banner
from service.web.run_frame import driven_frames, limit, run_frame, run_standing
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, Site, spool_sentence

router = APIRouter(tags=["home"])
_PAGE = 12


@dataclass(frozen=True, slots=True)
class RunLine:
    """A run in a list."""

    run_id: str
    title: str
    created_utc: str
    operator: str
    simulated: bool
    status: str
    step: str
    passed: int
    steps: int
    deviations: int
    robot: str
    standing: tuple[str, str] = ("Under way", "now")  # how it stands, and the tone of it
    why: str = ""  # it is stopped, and what is recommended
    fault: str = ""  # the fault of its record
    about: RunAbout = field(default_factory=RunAbout)


@dataclass(frozen=True, slots=True)
class StartableProtocol:
    """A protocol file that can be started."""

    file: str
    loaded: LoadedProtocol | None
    fault: str = ""
    space: str = ""  # why the disk will not do for it
    standing: ProtocolStanding | None = None
    changes: tuple[str, ...] = ()  # changes against the approved content of its id and version


class HomeQuery(RunSearch):
    """A page of the runs, or of those that match a search."""

    page: int = Field(1, ge=1, le=100_000)


@router.get("/", name="home", dependencies=[Depends(requires("read"))])
def home(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    wanted: Annotated[HomeQuery, Query()],
) -> HTMLResponse:
    """Show the runs in progress, then those that have ended, newest first, or those that match a search.

    Only the runs of the page shown are read whole.
    """
    found = {run.basics.run_id: run for run in find_runs(site.store, wanted)}
    rows = _in_order(site, found)
    pages = max(1, -(-len(rows) // _PAGE))
    page = min(wanted.page, pages)
    lines = [_line(site, row) for row in rows[_PAGE * (page - 1) : _PAGE * page]]
    asked = person.may("operate") and not wanted.active
    startable = [startable_of(path.name, site) for path in site.protocol_files()] if asked else []
    return render(
        request,
        "home/home.html.j2",
        uploading=spool_sentence(site),
        under_way=[line for line in lines if line.status in ("active", "paused")],
        ended=[line for line in lines if line.status not in ("active", "paused")],
        found=found,
        count=len(rows),
        wanted=wanted,
        results=RESULT_WORDS,
        query="".join(f"&{urlencode({name: value})}" for name, value in wanted.query().items()),
        page=page,
        pages=pages,
        protocols=startable,
        rig=site.rig.section,
    )


@router.get("/robots", name="robots", dependencies=[Depends(requires("read"))])
def robots(request: Request, site: CurrentSite, but: Annotated[str, Query(max_length=64)] = "") -> HTMLResponse:
    """Show the state of all robots that are being driven, for the script that keeps every page up to date."""
    return render(request, "page/robots.html.j2", others=driven_frames(site, but=but))


@router.post(
    "/theme",
    name="theme",
    dependencies=[Depends(requires("read", while_locked=True))],
    response_class=RedirectResponse,
)
def theme(
    site: CurrentSite,
    theme: Annotated[Literal["light", "dark", "auto"], Form()],
    back: Annotated[str, Form(max_length=400)] = "/",
) -> RedirectResponse:
    """Switch to light or dark on this screen; its browser remembers it."""
    # Only pages of this site: neither //elsewhere nor /\elsewhere.
    inside = back.startswith("/") and not back.startswith(("//", "/\\"))
    response = RedirectResponse(back if inside else "/", status_code=303)
    response.set_cookie("theme", theme, max_age=365 * 24 * 3600, samesite="lax", secure=site.secure, httponly=True)
    return response


def _in_order(site: Site, found: Collection[str]) -> list[RunRow]:
    """Return the found runs: those that a process drives, then open ones, then ended ones, each newest first."""
    driven = set(site.launcher.driven_runs())
    under_way = site.store.open_runs() | driven
    newest_first = [row for row in site.store.runs()[::-1] if row.run_id in found]
    return sorted(newest_first, key=lambda row: (row.run_id not in driven, row.run_id not in under_way))


def _unreadable(row: RunRow, fault: str) -> RunLine:
    return RunLine(
        row.run_id, row.run_id, row.created_utc, "", row.simulated, "unreadable", "", 0, 0, 0, "", fault=fault
    )


def _line(site: Site, row: RunRow) -> RunLine:
    try:
        log = site.run(row.run_id)
    except OrthocaptureError as error:
        return _unreadable(row, str(error))
    state = log.state
    # One small file a run is read, for those under way only.
    robot, standing, why = "", ("", ""), ""
    if not state.terminal or lost_arms(state):  # an arm that nobody has looked at outlasts its run
        now_utc_s = site.store.clock.utc_s()
        snapshot, driven = read_snapshot(site.data, row.run_id, now_utc_s), site.launcher.driven(row.run_id)
        robot = robot_banner(state, snapshot, now_utc_s, driven=driven).title
        if not state.terminal:
            stands = run_standing(log.protocol, state, driven=driven, robot=snapshot.robot)
            standing, why = (stands.word, stands.tone), stands.why
    return RunLine(
        run_id=row.run_id,
        title=log.protocol.title,
        created_utc=row.created_utc,
        operator=state.operator,
        simulated=state.simulated,
        status=state.status,
        step=log.protocol.step(state.current).title,
        passed=sum(step.phase == "passed" for step in state.steps.values()),
        steps=len(log.protocol.steps),
        deviations=len(state.deviations),
        robot=robot,
        standing=standing,
        why=why,
        about=log.root.about or RunAbout(),
    )


def startable_of(name: str, site: Site) -> StartableProtocol:
    """Load a protocol file, and look up whether it is approved on this site and whether the disk has space for it."""
    try:
        loaded = load_protocol(site.protocols / name, params_models())
        space = forecast_of(site.store, loaded.protocol, simulated=site.rig.section.simulated)
        standing = standing_of(site.store, loaded)
        changes = difference(standing.other.payload.source, loaded.source) if standing.other is not None else []
        words = "" if space.verdict == "enough" else space.words
        return StartableProtocol(name, loaded, "", words, standing, tuple(changes))
    except OrthocaptureError as error:
        return StartableProtocol(name, None, str(error))


_KNOWN = 20  # entries of earlier runs that a field offers


@router.get("/start", name="start_form", dependencies=[Depends(requires("read"))])
def start_form(
    request: Request, site: CurrentSite, person: SignedInPerson, protocol: Annotated[str, Query(max_length=200)]
) -> HTMLResponse:
    """Show fields of a new run of one protocol file; the site is filled in as in the run before."""
    if protocol not in {path.name for path in site.protocol_files()}:
        raise ConfigurationError(
            f"there is no protocol file {protocol!r}",
            where=str(site.protocols),
            remedy="Choose one of the first page",
        )
    earlier = [run.basics.about for run in find_runs(site.store, RunSearch())]
    return render(
        request,
        "home/start.html.j2",
        p=startable_of(protocol, site),
        rig=site.rig.section,
        place=next((about.site for about in earlier if about.site), ""),
        operator=person.full_name,
        known={field: _known(earlier, field) for field in ("specimen", "purpose", "site")},
        line=LINE_CHARACTERS,
        longest=TEXT_CHARACTERS,
    )


def _known(earlier: list[RunAbout], field: str) -> list[str]:
    """Return what was entered before, newest first, each once."""
    return list(dict.fromkeys(value for about in earlier if (value := str(getattr(about, field)))))[:_KNOWN]


@router.get("/protocols/{file}/checklist", name="protocol_checklist", dependencies=[Depends(requires("read"))])
def protocol_checklist(
    request: Request, site: CurrentSite, file: Annotated[str, Path(max_length=200)]
) -> HTMLResponse:
    """Show the checklist of a protocol that can be started. Raises ConfigurationError for any other file."""
    known = {path.name: path for path in site.protocol_files()}
    if file not in known:
        raise ConfigurationError(f"there is no protocol file {file!r}", where="protocols", remedy="Go to the runs")
    loaded = load_protocol(known[file], params_models())
    return _page(request, loaded.protocol, loaded.sha256)


@router.get("/runs/{run_id}/checklist", name="run_checklist", dependencies=[Depends(requires("read"))])
def run_checklist(request: Request, site: CurrentSite, run_id: Annotated[str, Path(max_length=64)]) -> HTMLResponse:
    """Show the checklist of the protocol that a run began with."""
    log = site.run(run_id)
    return _page(request, log.protocol, log.root.protocol_sha256, run_id=run_id, frame=run_frame(site, run_id))


def _page(
    request: Request, protocol: Protocol, sha256: str, *, run_id: str = "", frame: object = None
) -> HTMLResponse:
    steps = [
        {
            "step": step,
            "paragraphs": [" ".join(part.split()) for part in step.instructions.split("\n\n") if part.strip()],
            "limits": [
                f"{measure_name(gate.measure)} {limit(gate.min, gate.max, gate.unit)}"
                for gate in step.gates
                if gate.measure != "checklist_items_open"
            ],
            "warning": irreversible_warning(protocol, step) if step.irreversible else "",
        }
        for step in protocol.steps
    ]
    return render(
        request, "home/checklist.html.j2", frame=frame, protocol=protocol, sha256=sha256, steps=steps, run_id=run_id
    )


_OFFERED = 200  # runs to choose from


@router.get("/compare", name="compare", dependencies=[Depends(requires("read"))])
def compare_page(
    request: Request, site: CurrentSite, run: Annotated[list[str] | None, Query(max_length=64)] = None
) -> HTMLResponse:
    """Show two runs, or the choice of two. Raises UnknownRunError."""
    chosen = list(dict.fromkeys(run or []))
    comparison = compare_runs(*(ComparedRun.of(site.run(run_id)) for run_id in chosen)) if len(chosen) == 2 else None
    offered = find_runs(site.store, RunSearch())[:_OFFERED]
    missing = [run_id for run_id in chosen if run_id not in {each.basics.run_id for each in offered}]
    return render(
        request,
        "home/compare.html.j2",
        c=comparison,
        chosen=chosen,
        offered=offered,
        missing=missing,
        measure_name=measure_name,
    )


# --- calibration and accuracy over time, for each camera, lens and arm --------------------------------------------

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
