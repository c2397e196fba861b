"""Live capture: last image, verdicts, plan of the viewpoints, contact sheet, live view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field

from service.core.protocol.models import Step
from service.people.control import Control
from service.people.person import Person
from service.run_record import RunRecord
from service.web.page.rendering import part_names, render
from service.web.page.run_frame import run_frame
from service.web.record.board_images import BoardUse, board_uses
from service.web.record.images import Capture, captures_of
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

if TYPE_CHECKING:
    from service.web.capture.plan_drawing import PlanDrawing
    from service.web.capture.view import View

router = APIRouter(tags=["capture"])

RunId = Annotated[str, Path(max_length=64)]
Parts = Annotated[str, part_names("image", "plan", "sheet")]
SHEET = 60  # images on one page of the contact sheet
LISTED = 200  # viewpoints on one page of the table


class CaptureQuery(BaseModel):
    """Which step and which of its images to show; the page chooses what is not given."""

    step: str = Field("", max_length=64)
    viewpoint: str = Field("", max_length=64)
    seq: int = Field(0, ge=0, le=2**53)  # event of an image; 0: the newest
    page: int = Field(1, ge=1, le=100_000)  # of the contact sheet
    views: int = Field(0, ge=0, le=100_000)  # page of the table; 0: the one that shows where the run is
    replaced: bool = False  # list replaced images too
    plain: bool = False  # without the outlines of spheres


Wanted = Annotated[CaptureQuery, Query()]


@router.get("/runs/{run_id}/capture", name="capture", dependencies=[Depends(requires("read"))])
def capture(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, wanted: Wanted
) -> HTMLResponse:
    """Everything about the images of one step."""
    shown = _shown(site, person, run_id, wanted)
    return render(request, "capture/capture.html.j2", frame=run_frame(site, run_id), **shown)


@router.get("/runs/{run_id}/capture/parts/{names}", name="capture_parts", dependencies=[Depends(requires("read"))])
def capture_parts(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, names: Parts, wanted: Wanted
) -> HTMLResponse:
    """Parts of the page, all from the same moment, for the script that keeps the page up to date."""
    shown = _shown(site, person, run_id, wanted)
    return render(request, "capture/parts.html.j2", names=names.split(","), **shown)


def _shown(site: Site, person: Person, run_id: str, wanted: CaptureQuery) -> dict[str, Any]:
    # The planning of viewpoints brings scipy, which the start of the service does not wait for.
    from service.web.capture import view as capture_view  # noqa: PLC0415

    log = site.run(run_id)
    common = {"run_id": run_id, "steps": capture_view.capture_steps(log.protocol), "log": log}
    step = capture_view.step_to_show(log, wanted.step)
    if step is None:
        return {**common, "step": None, "held": any(s.kind == "manual_capture" for s in log.protocol.steps)}
    captures = captures_of(log, step.id)
    chosen = _chosen(captures, wanted)
    name = wanted.viewpoint or ("" if chosen is None else chosen.payload.viewpoint)
    views = capture_view.views_of(log, step)
    view = next((v for v in views if v.name == name), None)
    advice, suggestions = capture_view.suggestions_of(log, step)
    holder = Control(site.store).holder(run_id)
    return {
        **common,
        "step": step,
        "state": log.state.steps[step.id],
        **_table(views, view, wanted.views),
        **_sheet(log, step, captures, wanted),
        **_image(log, step, chosen, captures),
        "drawings": _drawings(log, views, name),
        "view": view,
        "redo": None if view is None else capture_view.redo_of(log, step, view, person.account),
        "in_control": person.may("operate") and holder.screen == person.screen,
        "advice": advice,
        "suggestions": suggestions,
        "following": not wanted.viewpoint and not wanted.seq,
        "query": wanted.model_dump(exclude={"page"}) | {"step": step.id},
    }


def _chosen(captures: Sequence[Capture], wanted: CaptureQuery) -> Capture | None:
    """The image of an event, else the newest valid one of the viewpoint, else the newest valid one."""
    by_event = next((c for c in captures if wanted.seq and c.seq == wanted.seq), None)
    if by_event is not None:
        return by_event
    valid = [c for c in captures if c.replaced is None]
    named = [c for c in valid if c.payload.viewpoint == wanted.viewpoint]
    return (named or ([] if wanted.viewpoint else valid) or [None])[-1]


def _table(views: list[View], view: View | None, page: int) -> dict[str, Any]:
    """A page of the table: the one asked for, or the one with the viewpoint that is shown or comes next."""
    from service.web.capture import view as capture_view  # noqa: PLC0415

    pages = max(1, -(-len(views) // LISTED))
    here = next((k for k, v in enumerate(views) if v is view or (view is None and v.state == "next")), 0)
    page = min(page or 1 + here // LISTED, pages)
    counts = {state: sum(v.state == state for v in views) for state in capture_view.WORDS}
    return {
        "views": views,
        "rows": views[(page - 1) * LISTED : page * LISTED],
        "views_page": page,
        "views_pages": pages,
        "counts": {state: count for state, count in counts.items() if count},
        "words": capture_view.WORDS,
        "tones": capture_view.TONES,
    }


def _sheet(log: RunRecord, step: Step, captures: Sequence[Capture], wanted: CaptureQuery) -> dict[str, Any]:
    """A page of the contact sheet: images with something wrong first, then newest first."""
    valid = [c for c in captures if c.replaced is None]
    uses = board_uses(log.state, log.events, step.id)
    listed = sorted(
        captures if wanted.replaced else valid, key=lambda c: _is_problem(c, uses.get(c.sha256))
    )  # stable
    pages = max(1, -(-len(listed) // SHEET))
    page = min(wanted.page, pages)
    return {
        "uses": uses,
        "captures": listed[::-1][(page - 1) * SHEET : page * SHEET],
        "replaced_count": len(captures) - len(valid),
        "page": page,
        "pages": pages,
    }


def _image(log: RunRecord, step: Step, chosen: Capture | None, captures: Sequence[Capture]) -> dict[str, Any]:
    """The large image, with what is known about it."""
    from service.web.capture import view as capture_view  # noqa: PLC0415
    from service.web.record.known_spheres import best_registration  # noqa: PLC0415

    valid = [c for c in captures if c.replaced is None]
    return {
        "capture": chosen,
        "verdicts": [] if chosen is None else capture_view.verdicts_of(log, step, chosen, valid),
        "sums": [] if chosen is None else capture_view.summary_of(step, chosen),
        "registered": best_registration(log) is not None and (chosen is None or chosen.replaced is None),
    }


def _drawings(log: RunRecord, views: Sequence[View], name: str) -> list[PlanDrawing]:
    """The plan of the viewpoints of each known station."""
    from service.web.capture import plan_drawing  # noqa: PLC0415
    from service.web.record import planned_poses  # noqa: PLC0415

    stations = dict.fromkeys(v.station for v in views if v.station)
    known = {station: planned_poses.station_of(log, station) for station in stations}
    drawings = (
        plan_drawing.plan_drawing(there, [v for v in views if v.station == station], name)
        for station, there in known.items()
        if there is not None
    )
    return [drawing for drawing in drawings if drawing is not None]


def _is_problem(capture: Capture, use: BoardUse | None) -> bool:
    """Whether something is wrong with an image that has not been replaced."""
    wrong = use.used is False if use is not None else not all(capture.payload.verdicts.values())
    return wrong and capture.replaced is None
