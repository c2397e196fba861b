"""The first page: runs under way and recorded, and protocols to start."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from pydantic import BaseModel, Field

from service.audit.runs.search import RESULT_WORDS, RESULTS, RunSearch, find_runs
from service.core.errors import OrthocaptureError
from service.core.protocol.models import LoadedProtocol, load_protocol
from service.core.records.entered import RunAbout
from service.core.records.events import RunStarted
from service.core.run.connections import lost_arms
from service.people.approvals import ProtocolStanding, difference, standing_of
from service.steps import params_models
from service.store.disk_space import forecast_of
from service.store.records import RunRow
from service.web.page.rendering import render
from service.web.page.robot_banner import robot_banner
from service.web.page.run_frame import driven_frames
from service.web.page.run_standing import run_standing
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

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
    fault: str = ""  # what is wrong with its record
    about: RunAbout = field(default_factory=RunAbout)


@dataclass(frozen=True, slots=True)
class StartableProtocol:
    """A protocol file."""

    file: str
    loaded: LoadedProtocol | None
    fault: str = ""
    space: str = ""  # why the disk will not do for it
    standing: ProtocolStanding | None = None
    changes: tuple[str, ...] = ()  # against the approved content of its id and version


class HomeQuery(BaseModel):
    """Page number and search of the first page."""

    page: int = Field(1, ge=1, le=100_000)
    q: str = Field("", max_length=200)
    since: str = Field("", max_length=200)
    until: str = Field("", max_length=200)
    result: str = Field("", max_length=200)

    def wanted(self) -> RunSearch:
        """The search."""
        return RunSearch(self.q, self.since, self.until, self.result if self.result in RESULTS else "")


@router.get("/", name="home", dependencies=[Depends(requires("read"))])
def home(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    asked_for: Annotated[HomeQuery, Query()],
) -> HTMLResponse:
    """The runs in progress, then those that have ended, newest first, or those that match a search.

    Only the runs of the page shown are read whole.
    """
    wanted = asked_for.wanted()
    found = {run.run_id: run for run in find_runs(site.store, wanted)}
    rows = _in_order(site, found)
    pages = max(1, -(-len(rows) // _PAGE))
    page = min(asked_for.page, pages)
    lines = [_line(site, row) for row in rows[_PAGE * (page - 1) : _PAGE * page]]
    asked = person.may("operate") and not wanted.active
    startable = [startable_of(path.name, site) for path in site.protocol_files()] if asked else []
    return render(
        request,
        "home/home.html.j2",
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
    """The state of all robots that are being driven, for the script that keeps every page up to date."""
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
    """Light or dark on this screen, remembered by its browser."""
    # Only pages of this site: neither //elsewhere nor /\elsewhere.
    inside = back.startswith("/") and not back.startswith(("//", "/\\"))
    response = RedirectResponse(back if inside else "/", status_code=303)
    response.set_cookie("theme", theme, max_age=365 * 24 * 3600, samesite="lax", secure=site.secure, httponly=True)
    return response


def _in_order(site: Site, found: Collection[str]) -> list[RunRow]:
    """The found runs: first those that a process drives, then other open ones, then ended ones, each newest first."""
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
    # Imported here: one small file a run is read for those under way only.
    from service.monitor.snapshot import read_snapshot  # noqa: PLC0415

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
        about=root.about or RunAbout() if isinstance(root := log.events[0].payload, RunStarted) else RunAbout(),
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
