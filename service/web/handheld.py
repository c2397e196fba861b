"""Capture by hand: live view with the way to go, release, the last image's verdict, and the hemisphere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter, Depends, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from service.computations.hand_held import HAND_BOARD, HAND_VIEW, PlaceStatus
from service.computations.live import COVERAGE_POINTS
from service.computations.records import Matrix, image_of
from service.core.gates import quantity
from service.core.measure_names import measure_name
from service.core.protocol import Protocol, Step
from service.core.recorded_devices import recorded_report
from service.core.records.run_events import CaptureAsked, DeviceOpened, ViewHeld
from service.core.run.actions import capture_refusal
from service.core.run.state import JobState
from service.followed_run import RunRecord
from service.people.control import Control
from service.people.person import Person
from service.steps.handheld import failure_words
from service.web.images import captures_of, step_to_show
from service.web.rendering import part_names, render
from service.web.run_frame import limit, run_frame
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, RunId, Site

# --- what the page shows, read from a run -------------------------------------------------------------------------

SIZE = 480.0  # of the drawing, which is square
_REACH = 190.0  # from the middle to the lowest place of the hemisphere
_LARGEST_ARROW = 30.0  # of the overlay, whose frame is 100 wide
_METRES_FOR_LARGEST = 0.25
_KINDS = (HAND_VIEW.name, HAND_BOARD.name)  # both give the same answer
_TOLD = ("images_used", "hemisphere_coverage", "coverage", "predicted_target_error_mm", "specimen_coverage")

SpotState = Literal["done", "open", "next"]


@dataclass(frozen=True, slots=True)
class PlanMarker:
    """A place of the hemisphere, or the camera, on the drawing."""

    name: str
    state: SpotState
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Overlay:
    """The marks over the live view, in a frame of 150 × 100: the camera's way in the picture, and nearer or away."""

    arrow: tuple[float, float] | None  # tip, from the middle
    nearer_m: float  # positive: towards the scene


@dataclass(frozen=True, slots=True)
class JudgedImage:
    """One image with what was found."""

    viewpoint: str
    sha256: str
    state: Literal["waiting", "used", "not_used"]
    why: str
    figures: str


@dataclass(frozen=True, slots=True)
class HandheldView:
    """The present state of a hand-held capture step."""

    step: Step
    running: bool
    words: str
    failures: tuple[str, ...]  # failures of work on the images: what failed, what to do
    photographs_from: str  # folder of a camera without a cable; "" for one that can be released from here
    overlay: Overlay | None
    spots: tuple[PlanMarker, ...]
    camera: PlanMarker | None
    seen: tuple[JudgedImage, ...]  # newest first
    figures: tuple[tuple[str, str, str, bool | None], ...]  # name, value, limit, whether it is met


def held_steps(protocol: Protocol) -> list[Step]:
    """Return the steps in which a person holds the camera."""
    return [step for step in protocol.steps if step.by_hand]


def held_now(log: RunRecord, step: Step) -> HandheldView:
    """Collect the state of the step from the record."""
    state = log.state.steps[step.id]
    jobs = {image_of(j).sha256: j for j in state.jobs.values() if j.kind in _KINDS}
    done = sorted((j for j in jobs.values() if j.status == "finished"), key=lambda j: j.enqueued_seq)
    last = done[-1] if done else None
    newest = max((j.enqueued_seq for j in jobs.values()), default=0)  # earlier failures have been shown already
    failed = [
        j
        for j in state.jobs.values()
        if j.status == "failed"
        and (j.kind == COVERAGE_POINTS.name or (j.kind in _KINDS and j.enqueued_seq == newest))
    ]
    running = log.state.current == step.id and state.phase == "running" and not log.state.paused
    captures = [c for c in captures_of(log, step.id) if c.replaced is None and isinstance(c.payload, ViewHeld)]
    answer = None if last is None else HAND_VIEW.read_answer(last.result)
    target = None if answer is None else answer.target
    here = None if answer is None else answer.T_level_camera
    places = () if answer is None else answer.places
    return HandheldView(
        step=step,
        running=running,
        words=answer.words if running and answer is not None else "",
        photographs_from=_photographs_from(log),
        failures=tuple(failure_words(job) for job in failed) if running else (),
        overlay=_overlay(here, target.T_level_camera) if running and here and target else None,
        spots=_spots(places, "" if target is None else target.name),
        camera=None if not here else _spot("camera", "done", here, _lowest(places)),
        seen=tuple(_seen(c.payload.viewpoint, c.sha256, jobs.get(c.sha256)) for c in reversed(captures)),
        figures=_figures(step, {} if last is None else last.measures),
    )


def _photographs_from(log: RunRecord) -> str:
    payloads = (event.payload for event in reversed(log.events))
    opened = (recorded_report(payload.report) for payload in payloads if isinstance(payload, DeviceOpened))
    camera = next((report for report in opened if report.identity.kind == "camera"), None)
    return "" if camera is None else camera.details.get("photographs_from", "")


def _overlay(here: Matrix, there: Matrix) -> Overlay:
    away = (np.linalg.inv(np.array(here)) @ np.array(there))[:3, 3]
    x, y, z = (float(v) for v in away)
    length = math.hypot(x, y)
    if length < 0.01:
        return Overlay(None, z)
    reach = _LARGEST_ARROW * min(1.0, length / _METRES_FOR_LARGEST) / length
    return Overlay((round(reach * x, 1), round(reach * y, 1)), z)


def _lowest(places: Sequence[PlaceStatus]) -> float:
    """Return the largest distance of a place from the vertical through the middle, metres."""
    radii = [math.hypot(p.T_level_camera[0][3], p.T_level_camera[1][3]) for p in places]
    return max([0.05, *radii])


def _spots(places: Sequence[PlaceStatus], target: str) -> tuple[PlanMarker, ...]:
    lowest = _lowest(places)
    return tuple(
        _spot(
            place.name,
            "next" if place.name == target else "done" if place.done else "open",
            place.T_level_camera,
            lowest,
        )
        for place in places
    )


def _spot(name: str, state: SpotState, T_level_camera: Matrix, lowest: float) -> PlanMarker:
    """Project a place onto the drawing: seen from above, with the person's side at the bottom."""
    x, y = T_level_camera[0][3], T_level_camera[1][3]
    scale = _REACH / lowest
    return PlanMarker(name, state, round(SIZE / 2 + scale * x, 1), round(SIZE / 2 - scale * y, 1))


def _seen(viewpoint: str, sha256: str, job: JobState | None) -> JudgedImage:
    if job is None or job.status == "enqueued":
        return JudgedImage(viewpoint, sha256, "waiting", "", "")
    if job.status == "failed":
        return JudgedImage(viewpoint, sha256, "not_used", job.message, "")
    m = job.measures
    parts: list[str] = []
    if m.get("spheres_expected"):
        parts.append(f"{m['spheres_seen']:.0f} of {m['spheres_expected']:.0f} spheres")
    if "edge_width_px" in m:
        parts.append(f"edges {m['edge_width_px']:.1f} px wide")
    if "clipped_fraction" in m:
        parts.append(f"{100 * m['clipped_fraction']:.1f} % clipped")
    if "corners" in m:
        parts.append(f"{m['corners']:.0f} corners")
    answer = HAND_VIEW.read_answer(job.result)
    return JudgedImage(viewpoint, sha256, "used" if answer.used else "not_used", answer.why, ", ".join(parts))


def _figures(step: Step, measures: Mapping[str, float]) -> tuple[tuple[str, str, str, bool | None], ...]:
    out: list[tuple[str, str, str, bool | None]] = []
    for gate in step.gates:
        if gate.measure not in _TOLD:  # those that are measured at the end
            continue
        value = measures.get(gate.measure)
        met = None
        if value is not None:
            met = (gate.min is None or value >= gate.min) and (gate.max is None or value <= gate.max)
        out.append(
            (measure_name(gate.measure), quantity(value, gate.unit), limit(gate.min, gate.max, gate.unit), met)
        )
    return tuple(out)


# --- the page -----------------------------------------------------------------------------------------------------

router = APIRouter(tags=["capture by hand"])

Name = Annotated[str, Query(max_length=64)]
Parts = Annotated[str, part_names("way", "image", "plan", "overlay")]


@dataclass(frozen=True, slots=True)
class HandheldPage:
    """The data that the page shows; `step` and `now` are None in a protocol without images by hand."""

    run_id: str
    log: RunRecord
    steps: list[Step]
    step: Step | None
    now: HandheldView | None
    attempt: int
    in_control: bool
    size: float  # size of the drawing of the hemisphere


@router.get("/runs/{run_id}/held", name="held", dependencies=[Depends(requires("read"))])
def held(request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, step: Name = "") -> HTMLResponse:
    """Show the page that a technician has beside the camera."""
    shown = _shown(site, person, run_id, step)
    return render(request, "handheld/handheld.html.j2", shown, frame=run_frame(site, run_id))


@router.get("/runs/{run_id}/held/parts/{names}", name="held_parts", dependencies=[Depends(requires("read"))])
def held_parts(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, names: Parts, step: Name = ""
) -> HTMLResponse:
    """Show parts of the page, all from the same moment, for the script that keeps the page up to date."""
    return render(request, "handheld/parts.html.j2", _shown(site, person, run_id, step), names=names.split(","))


@router.post("/runs/{run_id}/held", name="ask_capture", dependencies=[Depends(requires("operate"))])
def ask(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    step: Annotated[str, Form(max_length=64)],
    attempt: Annotated[int, Form(ge=1, le=10_000)],
    what: Annotated[Literal["release", "finish"], Form()],
) -> RedirectResponse:
    """Release the shutter, or end the capture with what it has."""
    log = site.run(run_id)
    Control(site.store).require(run_id, person)
    refusal = capture_refusal(log.protocol, log.state, step, attempt)
    if refusal is not None:
        raise refusal
    site.store.record(run_id, [CaptureAsked(step=step, attempt=attempt, what=what)], actor=person.account)
    return RedirectResponse(f"/runs/{run_id}/held", status_code=303)


def _shown(site: Site, person: Person, run_id: str, wanted: str) -> HandheldPage:

    log = site.run(run_id)
    steps = held_steps(log.protocol)
    step = step_to_show(log, steps, wanted)
    holder = Control(site.store).holder(run_id)
    return HandheldPage(
        run_id=run_id,
        log=log,
        steps=steps,
        step=step,
        now=None if step is None else held_now(log, step),
        attempt=1 if step is None else log.state.steps[step.id].attempt,
        in_control=person.may("operate") and holder.screen == person.screen,
        size=SIZE,
    )
