"""Live capture: last image, verdicts, plan of the viewpoints, contact sheet, live view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, Field

from service.computations.live import Suggestion
from service.core.protocol import Step
from service.followed_run import RunRecord
from service.people.control import Control
from service.people.person import Person
from service.web.capture_view import (
    TONES,
    WORDS,
    CameraImage,
    PlanDrawing,
    SheetImage,
    StepViewpoint,
    Verdict,
    ViewpointRedo,
    ViewState,
    camera_images,
    capture_steps,
    devices_in,
    plan_drawing,
    redo_of,
    sheet_image,
    suggestions_of,
    summary_of,
    verdicts_of,
    views_of,
)
from service.web.images import BoardUse, Capture, board_uses, captures_of, rig_cameras, step_to_show
from service.web.planned_poses import station_of
from service.web.rendering import part_names, render
from service.web.run_frame import run_frame
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, RunId, Site

router = APIRouter(tags=["capture"])

Parts = Annotated[str, part_names("image", "plan", "sheet")]
SHEET = 60  # images on one page of the contact sheet
LISTED = 200  # viewpoints on one page of the table


class CaptureQuery(BaseModel):
    """The query for a step and for its images to show; the page chooses what is not given."""

    step: str = Field("", max_length=64)
    viewpoint: str = Field("", max_length=64)
    seq: int = Field(0, ge=0, le=2**53)  # event of an image; 0: the newest
    page: int = Field(1, ge=1, le=100_000)  # page of the contact sheet
    views: int = Field(0, ge=0, le=100_000)  # page of the table; 0: the one that shows where the run is
    replaced: bool = False  # list replaced images too
    plain: bool = False  # leave out the outlines of spheres
    device: str = Field("", max_length=64)  # a further camera, whose images are shown; "": the first one


Wanted = Annotated[CaptureQuery, Query()]


@dataclass(frozen=True, slots=True)
class ViewTable:
    """The viewpoints of a step, and a page of the table that lists them."""

    views: list[StepViewpoint]
    rows: list[StepViewpoint]  # the rows on this page
    page: int
    pages: int
    counts: Mapping[ViewState, int]  # number of viewpoints in each state, without zeros


@dataclass(frozen=True, slots=True)
class ContactSheet:
    """A page of the contact sheet."""

    images: list[SheetImage]  # the images on this page
    devices: list[str]  # further cameras that took images in this step
    replaced: int  # images of the step that no longer count
    page: int
    pages: int


@dataclass(frozen=True, slots=True)
class ChosenImage:
    """The large image; `capture` is None where the step has none to show."""

    capture: Capture | None
    camera: CameraImage | None  # the camera whose image is large
    cameras: list[CameraImage]  # all that exposed at this viewpoint
    sums: list[Verdict]  # verdicts on all images up to this one
    registered: bool  # the spheres have the numbers of the registration


@dataclass(frozen=True, slots=True)
class StepImages:
    """The images of one step, and everything that the page shows about them.

    Attributes:
        run_id: the run's identifier.
        step: the step whose images they are.
        table: the table of its viewpoints.
        sheet: the contact sheet of its images.
        image: the large one.
        drawings: the viewpoints from above, one drawing a station.
        view: the chosen viewpoint.
        redo: the answer to whether it may be redone; None without a chosen viewpoint.
        in_control: the person's screen has control of the run.
        advice, suggestions: a text on what the images need, and the views that would help most.
        following: the page shows the newest image.
        query: the query of the page.
        tail: `query` as the query of an address, for the parts of the page.
        words, tones: labels and tones of the states of viewpoints.
        reasons: presets for a redo.
        csrf: token of the forms.
    """

    run_id: str
    step: Step
    table: ViewTable
    sheet: ContactSheet
    image: ChosenImage
    drawings: list[PlanDrawing]
    view: StepViewpoint | None
    redo: ViewpointRedo | None
    in_control: bool
    advice: str
    suggestions: tuple[Suggestion, ...]
    following: bool
    query: CaptureQuery
    tail: str
    words: Mapping[ViewState, str]
    tones: Mapping[ViewState, str]
    reasons: tuple[str, ...]
    csrf: str


@dataclass(frozen=True, slots=True)
class CapturePage:
    """The data that the page shows."""

    run_id: str
    log: RunRecord
    steps: list[Step]  # the steps that take images with the robot
    held: bool  # a person holds the camera in another step
    further_cameras: tuple[str, ...]  # the rig's further cameras
    images: StepImages | None  # None where no step takes images with the robot


@router.get("/runs/{run_id}/capture", name="capture", dependencies=[Depends(requires("read"))])
def capture(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, wanted: Wanted
) -> HTMLResponse:
    """Show everything about the images of one step."""
    shown = _shown(site, person, run_id, wanted)
    return render(request, "capture/capture.html.j2", shown, frame=run_frame(site, run_id))


@router.get("/runs/{run_id}/capture/parts/{names}", name="capture_parts", dependencies=[Depends(requires("read"))])
def capture_parts(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, names: Parts, wanted: Wanted
) -> HTMLResponse:
    """Show parts of the page, all from the same moment, for the script that keeps the page up to date."""
    shown = _shown(site, person, run_id, wanted)
    return render(request, "capture/parts.html.j2", shown, names=names.split(","))


def _shown(site: Site, person: Person, run_id: str, wanted: CaptureQuery) -> CapturePage:
    # The planning of viewpoints brings scipy, which the start of the service does not wait for.
    log = site.run(run_id)
    steps = capture_steps(log.protocol)
    step = step_to_show(log, steps, wanted.step)
    return CapturePage(
        run_id=run_id,
        log=log,
        steps=steps,
        held=any(s.by_hand for s in log.protocol.steps),
        further_cameras=rig_cameras(log),
        images=None if step is None else _of_step(site, person, log, step, wanted),
    )


def _of_step(site: Site, person: Person, log: RunRecord, step: Step, wanted: CaptureQuery) -> StepImages:
    captures = captures_of(log, step.id)
    chosen = _chosen(captures, wanted)
    name = wanted.viewpoint or ("" if chosen is None else chosen.payload.viewpoint)
    views = views_of(log, step)
    view = next((v for v in views if v.name == name), None)
    advice, suggestions = suggestions_of(log, step)
    return StepImages(
        run_id=log.run_id,
        step=step,
        table=_table(views, view, wanted.views),
        sheet=_sheet(log, step, captures, wanted),
        image=_image(log, step, chosen, captures, wanted.device),
        drawings=_drawings(log, views, name),
        view=view,
        redo=None if view is None else redo_of(log, step, view, person.account),
        in_control=person.may("operate") and Control(site.store).holder(log.run_id).screen == person.screen,
        advice=advice,
        suggestions=suggestions,
        following=not wanted.viewpoint and not wanted.seq,
        query=wanted,
        tail="?" + urlencode(wanted.model_dump(exclude={"page"}) | {"step": step.id}),
        words=WORDS,
        tones=TONES,
        reasons=log.protocol.reasons.redo,
        csrf=person.csrf,
    )


def _chosen(captures: Sequence[Capture], wanted: CaptureQuery) -> Capture | None:
    """Return the image of an event, else the newest valid one of the viewpoint, else the newest valid one."""
    by_event = next((c for c in captures if wanted.seq and c.seq == wanted.seq), None)
    if by_event is not None:
        return by_event
    valid = [c for c in captures if c.replaced is None]
    named = [c for c in valid if c.payload.viewpoint == wanted.viewpoint]
    return (named or ([] if wanted.viewpoint else valid) or [None])[-1]


def _table(views: list[StepViewpoint], view: StepViewpoint | None, page: int) -> ViewTable:
    """Return a page of the table: the one asked for, or the one with the viewpoint that is shown or comes next."""
    pages = max(1, -(-len(views) // LISTED))
    here = next((k for k, v in enumerate(views) if v is view or (view is None and v.state == "next")), 0)
    page = min(page or 1 + here // LISTED, pages)
    counts = Counter(v.state for v in views)
    return ViewTable(
        views=views,
        rows=views[(page - 1) * LISTED : page * LISTED],
        page=page,
        pages=pages,
        counts={state: counts[state] for state in WORDS if counts[state]},
    )


def _sheet(log: RunRecord, step: Step, captures: Sequence[Capture], wanted: CaptureQuery) -> ContactSheet:
    """Return a page of the contact sheet: images with something wrong first, then newest first."""
    valid = [c for c in captures if c.replaced is None]
    uses = board_uses(log.state, log.events, step.id)
    listed = sorted(
        captures if wanted.replaced else valid, key=lambda c: _is_problem(c, uses.get(c.sha256))
    )  # stable
    devices = devices_in(log, captures)
    device = wanted.device if wanted.device in devices else ""
    images = [image for c in listed[::-1] if (image := sheet_image(log, c, uses, device)) is not None]
    pages = max(1, -(-len(images) // SHEET))
    page = min(wanted.page, pages)
    return ContactSheet(
        images=images[(page - 1) * SHEET : page * SHEET],
        devices=devices,
        replaced=len(captures) - len(valid),
        page=page,
        pages=pages,
    )


def _image(
    log: RunRecord, step: Step, chosen: Capture | None, captures: Sequence[Capture], device: str
) -> ChosenImage:
    """Return the large image, with what is known about it."""
    from service.web.outlines import displayed_registration  # noqa: PLC0415 - the matching of spheres, not needed to start

    valid = [c for c in captures if c.replaced is None]
    cameras: list[CameraImage] = []
    if chosen is not None:
        cameras = camera_images(log, chosen, verdicts_of(log, step, chosen, valid), valid)
    return ChosenImage(
        capture=chosen,
        camera=next((one for one in cameras if one.device == device), cameras[0] if cameras else None),
        cameras=cameras,
        sums=[] if chosen is None else summary_of(step, chosen),
        registered=displayed_registration(log) is not None and (chosen is None or chosen.replaced is None),
    )


def _drawings(log: RunRecord, views: Sequence[StepViewpoint], name: str) -> list[PlanDrawing]:
    """Return the plan of the viewpoints of each known station."""
    stations = dict.fromkeys(v.station for v in views if v.station)
    known = {station: station_of(log, station) for station in stations}
    drawings = (
        plan_drawing(there, [v for v in views if v.station == station], name)
        for station, there in known.items()
        if there is not None
    )
    return [drawing for drawing in drawings if drawing is not None]


def _is_problem(capture: Capture, use: BoardUse | None) -> bool:
    """Return whether something is wrong with an image that has not been replaced."""
    wrong = use.used is False if use is not None else not all(capture.payload.verdicts.values())
    return wrong and capture.replaced is None
