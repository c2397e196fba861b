"""Capture by hand: live view with the way to go, release, last image, hemisphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from fastapi import APIRouter, Depends, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from service.core.protocol import Step
from service.core.records.run_events import CaptureAsked
from service.core.run.actions import capture_refusal
from service.followed_run import RunRecord
from service.people.control import Control
from service.people.person import Person
from service.web.page.rendering import part_names, render
from service.web.page.run_frame import run_frame
from service.web.record.images import step_to_show
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, RunId, Site

if TYPE_CHECKING:
    from service.web.handheld.view import HandheldView

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
    from service.web.handheld import view as held_view  # noqa: PLC0415 - brings numerics that the start does not wait for

    log = site.run(run_id)
    steps = held_view.held_steps(log.protocol)
    step = step_to_show(log, steps, wanted)
    holder = Control(site.store).holder(run_id)
    return HandheldPage(
        run_id=run_id,
        log=log,
        steps=steps,
        step=step,
        now=None if step is None else held_view.held_now(log, step),
        attempt=1 if step is None else log.state.steps[step.id].attempt,
        in_control=person.may("operate") and holder.screen == person.screen,
        size=held_view.SIZE,
    )
