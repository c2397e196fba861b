"""The guided screen of a run: one step at a time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import HTMLResponse
from markupsafe import Markup

from service.core.gates.dependence import AcceptedGate, accepted_gates
from service.core.gates.release import loses_release
from service.core.protocol.models import Step
from service.core.records.entered import about_rows
from service.core.records.events import ControlTaken, Event, RunStarted
from service.core.recovery.reasons import Reasons
from service.dataset.registrations import evaluated, shared_adjustment_note
from service.jobs.registration.evaluate import Row
from service.monitor.snapshot import read_snapshot
from service.people.control import Control
from service.people.person import Account, Person
from service.rig import SigningSection
from service.run_record import RunRecord, open_jobs, results_to_come
from service.steps import step_kinds
from service.store.disk_space import forecast_of
from service.store.durable_effects import utc_text
from service.web.page.rendering import part_names, render
from service.web.page.run_frame import run_frame
from service.web.record.recorded_rig import rig_cameras
from service.web.run.notes import PageNote, notes_of
from service.web.run.view import run_view
from service.web.run.view_records import RunView, Viewer
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["run"])

RunId = Annotated[str, Path(max_length=64)]
Name = Annotated[str, Query(max_length=64)]
Parts = Annotated[str, part_names("banner", "control", "vitals", "step", "actions", "dialogs", "side")]
_DRAWINGS = files("service.web.run") / "drawings"


@dataclass(frozen=True, slots=True)
class RunPage:
    """What the page shows.

    Attributes:
        view: the run and the step on the screen.
        acceptors: accounts that may accept the question's figures.
        looking_back: the step on the screen is not the current one.
        dialog: the one that is open without script; "" for none.
        notes: people's notes on the step, or on the whole run once it has ended.
        about: what was entered when the run began: name and text.
        reasons: presets of the protocol.
        signing: what may stand for a password.
        drawing: beside the instructions.
        lens_step: the live view belongs to this step.
        board_plan: version of the plan of the step's board images; 0 for other steps.
        now_utc: time of the page.
        depends: acceptances on which the run's results depend.
        result_table: rows of the evaluation.
        result_note: what some of these rows share.
        further_cameras: of the rig, for the live view.
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
    """The current step, or another one to look at."""
    shown = _shown(site, person, run_id, step, dialog)
    return render(request, "run/run.html.j2", shown, frame=run_frame(site, run_id))


@router.get("/runs/{run_id}/parts/{names}", name="run_parts", dependencies=[Depends(requires("read"))])
def run_parts(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, names: Parts, step: Name = ""
) -> HTMLResponse:
    """Parts of the page, all from the same moment, for the script that keeps the page up to date."""
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
    """Whether a person focuses or aims the camera now: the live view belongs there."""
    focuses = view.shown.drawing == "camera" and view.shown.only_ticks
    aims = view.shown.drawing == "layout_photo" and view.mode in ("ask", "more")
    return view.shown.current and (focuses or aims)


def _about(log: RunRecord) -> list[tuple[str, str]]:
    """What was entered of the run when it began."""
    root = log.events[0].payload
    return about_rows(root.about) if isinstance(root, RunStarted) else []


def _board_plan(log: RunRecord, step: str) -> int:
    """Version of the plan of a step's board images: one more than the plans that are recorded; 0 for other steps."""
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
    """The last change of control, if somebody else took it from this person."""
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
    """The drawing of a step, to stand in a page: one of ours, or the SVG of a plug-in's kind; empty without one."""
    kind = step_kinds().get(step.kind)
    own = "" if kind is None else kind.drawing
    found = _drawings().get(step.drawing or own)
    if found is not None:
        return found
    return Markup(own if own.startswith("<svg") and not step.drawing else "")
