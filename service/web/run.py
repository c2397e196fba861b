"""The guided screen of a run, one step at a time, with its notes and its news as server-sent events."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, StreamingResponse
from markupsafe import Markup
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile

from service.computations.evaluate import Row
from service.core.errors import DataError, OrthocaptureError
from service.core.gates import AcceptedGate, accepted_gates, loses_release
from service.core.protocol import Reasons, Step
from service.core.records.base import ArtefactRef
from service.core.records.entered import NoteTaken, about_rows
from service.core.records.events import Event
from service.core.records.run_events import ControlTaken, RunStarted
from service.dataset.registrations import evaluated, shared_adjustment_note
from service.followed_run import RunRecord
from service.monitor.snapshot import STALE_S, read_snapshot
from service.people.control import Control
from service.people.person import Account, Person
from service.rig import SigningSection
from service.run_acts import NotePhotograph, require_size, take_note
from service.run_record import open_jobs, results_to_come
from service.steps import step_kinds
from service.store.disk_space import forecast_of
from service.store.durable_effects import utc_text
from service.web.images import rig_cameras
from service.web.rendering import part_names, render
from service.web.run_frame import coats_of, run_frame
from service.web.run_view import run_view
from service.web.run_view_records import RunView, Viewer
from service.web.security import SignedInPerson, requires, token_of
from service.web.site import CurrentSite, RunId, Site, spool_of

router = APIRouter(tags=["run"])


@dataclass(frozen=True, slots=True)
class PageNote:
    """A note as pages show it."""

    seq: int
    at_utc: str
    by: str
    step: str
    text: str
    photograph: ArtefactRef | None


def notes_of(events: Iterable[Event], step: str = "") -> tuple[PageNote, ...]:
    """Return the notes of a run, or of one of its steps, in order."""
    return tuple(
        PageNote(event.seq, event.at_utc, event.actor, note.step, note.text, note.photograph)
        for event in events
        if isinstance(note := event.payload, NoteTaken) and step in ("", note.step)
    )


@router.post("/runs/{run_id}/notes", name="take_note", dependencies=[Depends(requires("operate"))])
async def take(request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Record a note. This does not need control of the run: anybody who works on it may write one.

    The form is read here, after the guard. As parameters of the route it would be read before the guard, and clients
    that are not signed in could fill the disk with photographs.
    """
    async with request.form() as form:
        text, step = (value if isinstance(value := form.get(name), str) else "" for name in ("text", "step"))
        file = form.get("photograph")
        photograph = None
        if isinstance(file, UploadFile) and (file.filename or file.size):
            name = file.filename or "photograph"
            require_size(file.size or 0, name)
            photograph = NotePhotograph(await file.read(), name)
        elif isinstance(file, str) and file:
            raise DataError("the photograph did not arrive", where=run_id, remedy="Load the page again and repeat")
    log = await run_in_threadpool(site.run, run_id)
    event = await run_in_threadpool(
        lambda: take_note(log, text, photograph, step=step, actor=person.account, via="web")
    )
    note = event.payload
    back = f"?step={note.step}" if isinstance(note, NoteTaken) and note.step != log.state.current else ""
    return RedirectResponse(f"/runs/{run_id}{back}", status_code=303)


_LOOK_S = 0.3
_BEAT_S = 1.5  # a page that hears nothing for twice this says that the connection is lost
_CHECK_S = 5.0


@router.get("/runs/{run_id}/stream", name="stream", dependencies=[Depends(requires("read"))])
async def stream(request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId) -> StreamingResponse:
    """Send `changed` with {"seq", "monitor", "locked"} whenever one of them has changed.

    `replaced` ends the stream: the sign-in has opened more streams than it may have, and this is the oldest.
    """
    await run_in_threadpool(site.store.head, run_id)  # an unknown run is refused before the stream begins
    return StreamingResponse(
        _news(request, site, person.screen, run_id),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


async def _news(request: Request, site: Site, screen: str, run_id: str) -> AsyncGenerator[str]:
    told: tuple[int, int, bool] | None = None
    clock = site.store.clock
    beat_s = checked_s = clock.monotonic_s()
    token, locked = token_of(request, site), False
    with site.streams.opened(screen) as place:
        while not await request.is_disconnected():
            now_s = clock.monotonic_s()
            if place.replaced:
                yield "event: replaced\ndata: {}\n\n"
                return
            if now_s - checked_s > _CHECK_S:
                checked_s = now_s
                person = await run_in_threadpool(_signed_in, site, token)
                if person is None:
                    yield "event: signed_out\ndata: {}\n\n"
                    return
                locked = person.locked
            news = (*await run_in_threadpool(newest, site, run_id), locked)
            if news != told:
                told, beat_s = news, now_s
                data = {"seq": news[0], "monitor": news[1], "locked": locked}
                yield f"event: changed\ndata: {json.dumps(data)}\n\n"
            elif now_s - beat_s > _BEAT_S:
                beat_s = now_s
                yield "event: beat\ndata: {}\n\n"
            await asyncio.sleep(_LOOK_S)


def _signed_in(site: Site, token: str) -> Person | None:
    """Return who sits there; a screen that was left alone is locked by this look."""
    return site.people.person(token, idle_lock_s=site.idle_lock_s, deliberate=False)


def newest(site: Site, run_id: str) -> tuple[int, int]:
    """Return the last event, and a number that changes with the runner's reports or silence, control, a coat's age.

    Who asks for control, and whether that was refused, are no events of the run: they are rows of the site.
    """
    now_utc_s = site.store.clock.utc_s()
    snapshot = read_snapshot(site.data, run_id, now_utc_s)
    silent = snapshot.age_s(now_utc_s) // STALE_S if snapshot.stale(now_utc_s) else 0
    shown = (silent, Control(site.store).holder(run_id), *_ages(site, run_id), *snapshot.shown())
    return site.store.head(run_id), hash(shown)


def _ages(site: Site, run_id: str) -> list[str]:
    """Return what the pages say of a coat's age; nothing of an unreadable run, as its pages say so themselves."""
    try:
        return [coat.title for coat in coats_of(site, site.run(run_id))]
    except OrthocaptureError:
        return []


Name = Annotated[str, Query(max_length=64)]
Parts = Annotated[str, part_names("banner", "control", "vitals", "step", "actions", "dialogs", "side")]
_DRAWINGS = files("service.web") / "drawings"


@dataclass(frozen=True, slots=True)
class RunPage:
    """The data that the page shows.

    Attributes:
        view: the run and the step on the screen.
        acceptors: accounts that may accept the question's figures.
        looking_back: the step on the screen is not the current one.
        dialog: the dialog that is open without script; "" for none.
        notes: people's notes on the step, or on the whole run once it has ended.
        about: the name and text of each thing that was entered when the run began.
        reasons: the protocol's presets of reasons.
        signing: the secrets that may stand for a password.
        drawing: the drawing beside the instructions.
        lens_step: true if the live view belongs to this step.
        board_plan: version of the plan of the step's board images; 0 for other steps.
        now_utc: time of the page.
        depends: acceptances on which the run's results depend.
        result_table: rows of the evaluation.
        result_note: a note on what some of these rows share.
        further_cameras: the rig's further cameras, for the live view.
    """

    view: RunView
    acceptors: list[Account]
    looking_back: bool
    dialog: str
    notes: tuple[PageNote, ...]
    about: list[tuple[str, str]]
    reasons: Reasons
    signing: SigningSection
    drawing: Markup
    lens_step: bool
    board_plan: int
    now_utc: str
    depends: tuple[AcceptedGate, ...]
    result_table: list[Row]
    result_note: str
    further_cameras: tuple[str, ...]


@router.get("/runs/{run_id}", name="run", dependencies=[Depends(requires("read"))])
def run(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, step: Name = "", dialog: Name = ""
) -> HTMLResponse:
    """Show the current step, or another one to look at."""
    shown = _shown(site, person, run_id, step, dialog)
    return render(request, "run/run.html.j2", shown, frame=run_frame(site, run_id))


@router.get("/runs/{run_id}/parts/{names}", name="run_parts", dependencies=[Depends(requires("read"))])
def run_parts(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, names: Parts, step: Name = ""
) -> HTMLResponse:
    """Show parts of the page, all from the same moment, for the script that keeps the page up to date."""
    asked = names.split(",")
    frame = run_frame(site, run_id) if "banner" in asked else None
    shown = None if asked == ["banner"] else _shown(site, person, run_id, step)
    return render(request, "run/parts.html.j2", shown, names=asked, of_run=frame)


def _shown(site: Site, person: Person, run_id: str, step: str, dialog: str = "") -> RunPage:
    log, now_utc = site.run(run_id), site.store.clock.utc_now().isoformat()
    view = run_view(
        log,
        read_snapshot(site.data, run_id, site.store.clock.utc_s()),
        _viewer(site, person, log),
        driven=site.launcher.driven(run_id),
        show=step,
        to_come=[left.text for left in results_to_come(log)],
        computing=open_jobs(log),
        space=None if log.state.terminal else forecast_of(site.store, log.protocol, log.state),
        spool=None if log.state.terminal else spool_of(site),
        earlier={} if log.state.terminal else site.step_times(run_id),
        now_utc=now_utc,
    )
    looking_back = bool(step) and view.shown.id != view.current
    role = view.question.acceptance.role if view.question.acceptance else ""
    return RunPage(
        view=view,
        # Offered by name, so that nobody types one with gloves.
        acceptors=[a for a in site.people.accounts.all() if (a.role, a.state) == (role, "active")] if role else [],
        looking_back=looking_back,
        dialog=dialog,
        notes=notes_of(log.events, "" if view.mode == "ended" and not looking_back else view.shown.id),
        about=_about(log),
        reasons=log.protocol.reasons,
        signing=site.rig.section.signing,
        drawing=drawing(log.protocol.step(view.shown.id)),
        lens_step=_aims(view),
        board_plan=_board_plan(log, view.shown.id),
        now_utc=now_utc,
        depends=accepted_gates(log.protocol, log.state),
        result_table=evaluated(log.protocol, log.state),
        result_note=shared_adjustment_note(log.protocol, log.state),
        further_cameras=rig_cameras(log),
    )


def _aims(view: RunView) -> bool:
    """Return whether a person focuses or aims the camera now: the live view belongs there."""
    focuses = view.shown.drawing == "camera" and view.shown.only_ticks
    aims = view.shown.drawing == "layout_photo" and view.mode in ("ask", "more")
    return view.shown.current and (focuses or aims)


def _about(log: RunRecord) -> list[tuple[str, str]]:
    """Return what was entered of the run when it began."""
    root = log.events[0].payload
    return about_rows(root.about) if isinstance(root, RunStarted) else []


def _board_plan(log: RunRecord, step: str) -> int:
    """Return the version of a step's plan of board images: one more than the recorded plans; 0 for other steps."""
    if getattr(log.protocol.step(step).params, "board_poses", None) is None:
        return 0
    return 1 + sum(note.note == "board_poses" for note in log.state.steps[step].notes)


def _viewer(site: Site, person: Person, log: RunRecord) -> Viewer:
    holder = Control(site.store).holder(log.run_id)
    mine = holder.screen == person.screen and bool(holder.screen)
    refused = holder.refused_screen == person.screen
    lost = None if mine else _taken_from(log, person.account)
    names = {a.account: a.full_name for a in site.people.accounts.all()} if lost else {}
    return Viewer(
        may_operate=person.may("operate"),
        may_sign=person.may("sign"),
        role=person.role,
        loses_release=person.may("release") and loses_release(log.protocol, log.state, person.account),
        may_take_over=person.role == "supervisor",
        in_control=mine and person.may("operate"),
        holder=holder.full_name,
        holder_screen=holder.screen,
        mine_elsewhere=not mine and bool(holder.screen) and holder.account == person.account,
        asked_by=holder.asked_by_name,
        asked_by_screen=holder.asked_by_screen,
        asked_by_me=bool(holder.asked_by_screen) and holder.asked_by_screen == person.screen,
        refused_by=holder.full_name if refused else "",
        refused_utc=utc_text(datetime.fromtimestamp(holder.refused_utc_s, UTC)) if refused else "",
        taken_over_by="" if lost is None else names.get(lost[0].actor, lost[0].actor),
        taken_over_utc="" if lost is None else lost[0].at_utc,
        taken_over_reason="" if lost is None else lost[1].reason,
    )


def _taken_from(log: RunRecord, account: str) -> tuple[Event, ControlTaken] | None:
    """Return the last change of control, if somebody else took it from this person."""
    changes = ((event, taken) for event in reversed(log.events) if isinstance(taken := event.payload, ControlTaken))
    last = next(changes, None)
    if last is None or last[0].actor == account:
        return None
    return last if (last[1].how, last[1].previous) == ("taken_over", account) else None


@cache
def _drawings() -> dict[str, Markup]:
    # Our own files; they stand inside the page so that they take its colours.
    found = sorted((file for file in _DRAWINGS.iterdir() if file.name.endswith(".svg")), key=lambda file: file.name)
    return {file.name.removesuffix(".svg"): Markup(file.read_text("utf-8")) for file in found}


def drawing(step: Step) -> Markup:
    """Return a step's drawing, to stand in a page: one of ours, or the SVG of a plug-in's kind; empty without one."""
    kind = step_kinds().get(step.kind)
    own = "" if kind is None else kind.drawing
    found = _drawings().get(step.drawing or own)
    if found is not None:
        return found
    return Markup(own if own.startswith("<svg") and not step.drawing else "")
