"""The guided screen of a run: one step at a time."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import HTMLResponse
from markupsafe import Markup

from service.core.gates.dependence import accepted_gates
from service.core.records.entered import about_rows
from service.core.records.events import RunStarted
from service.dataset.registrations import evaluated, shared_adjustment_note
from service.monitor.snapshot import read_snapshot
from service.people.control import Control
from service.people.person import Person
from service.run_record import RunRecord, results_to_come
from service.store.files.space_used import forecast_of
from service.web.page.rendering import part_names, render
from service.web.page.run_frame import run_frame
from service.web.run.notes import notes_of
from service.web.run.view import run_view
from service.web.run.view_records import Viewer
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["run"])

RunId = Annotated[str, Path(max_length=64)]
Name = Annotated[str, Query(max_length=64)]
Parts = Annotated[str, part_names("banner", "control", "vitals", "step", "actions", "dialogs", "side")]
_DRAWINGS = files("service.web.run") / "drawings"


@router.get("/runs/{run_id}", name="run", dependencies=[Depends(requires("read"))])
def run(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, step: Name = "", dialog: Name = ""
) -> HTMLResponse:
    """The current step, or another one to look at."""
    return render(
        request, "run/run.html.j2", frame=run_frame(site, run_id), **_shown(site, person, run_id, step, dialog)
    )


@router.get("/runs/{run_id}/parts/{names}", name="run_parts", dependencies=[Depends(requires("read"))])
def run_parts(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, names: Parts, step: Name = ""
) -> HTMLResponse:
    """Parts of the page, all from the same moment, for the script that keeps the page up to date."""
    asked = names.split(",")
    frame = run_frame(site, run_id) if "banner" in asked else None
    shown = {} if asked == ["banner"] else _shown(site, person, run_id, step)
    return render(request, "run/parts.html.j2", names=asked, of_run=frame, **shown)


def _shown(site: Site, person: Person, run_id: str, step: str, dialog: str = "") -> dict[str, Any]:
    log = site.run(run_id)
    view = run_view(
        log,
        read_snapshot(site.data, run_id),
        _viewer(site, person, run_id),
        driven=site.launcher.driven(run_id),
        show=step,
        to_come=[left.text for left in results_to_come(log)],
        space=None if log.state.terminal else forecast_of(site.store, log.protocol, log.state),
    )
    looking_back = bool(step) and view.shown.id != view.current
    role = view.question.acceptance.role if view.question.acceptance else ""
    return {
        "view": view,
        # Offered by name, so that nobody types one with gloves.
        "acceptors": [a for a in site.people.accounts.all() if (a.role, a.state) == (role, "active")] if role else [],
        "looking_back": looking_back,
        "dialog": dialog,
        "notes": notes_of(log.events, "" if view.mode == "ended" and not looking_back else view.shown.id),
        "about": _about(log),
        "reasons": log.protocol.reasons,
        "signing": site.rig.section.signing,
        "drawing": drawing(view.shown.drawing),
        # Where the camera is set up the lens is focused: the live view belongs there.
        "lens_step": view.shown.drawing == "camera" and view.shown.current and view.shown.kind == "checklist",
        "board_plan": _board_plan(log, view.shown.id),
        "now_utc": datetime.now(UTC).isoformat(),
        "depends": accepted_gates(log.protocol, log.state),
        "result_table": evaluated(log.protocol, log.state),
        "result_note": shared_adjustment_note(log.protocol, log.state),
    }


def _about(log: RunRecord) -> list[tuple[str, str]]:
    """What was entered of the run when it began."""
    root = log.events[0].payload
    return about_rows(root.about) if isinstance(root, RunStarted) else []


def _board_plan(log: RunRecord, step: str) -> int:
    """Version of the plan of a step's board images: one more than the plans that are recorded; 0 for other steps."""
    if getattr(log.protocol.step(step).params, "board_poses", None) is None:
        return 0
    return 1 + sum(note.note == "board_poses" for note in log.state.steps[step].notes)


def _viewer(site: Site, person: Person, run_id: str) -> Viewer:
    holder = Control(site.store).holder(run_id)
    mine = holder.screen == person.screen and bool(holder.screen)
    return Viewer(
        may_operate=person.may("operate"),
        may_take_over=person.role == "supervisor",
        in_control=mine and person.may("operate"),
        holder=holder.full_name,
        holder_screen=holder.screen,
        mine_elsewhere=not mine and bool(holder.screen) and holder.account == person.account,
        asked_by=holder.asked_by_account,
        asked_by_me=bool(holder.asked_by_screen) and holder.asked_by_screen == person.screen,
    )


@cache
def _drawings() -> dict[str, Markup]:
    # Our own files; they stand inside the page so that they take its colours.
    found = sorted((file for file in _DRAWINGS.iterdir() if file.name.endswith(".svg")), key=lambda file: file.name)
    return {file.name.removesuffix(".svg"): Markup(file.read_text("utf-8")) for file in found}


def drawing(name: str) -> Markup:
    """A drawing by its name, to stand in a page; empty when there is none of this name."""
    return _drawings().get(name, Markup(""))
