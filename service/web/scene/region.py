"""Drawing a region of the ground truth on the 3D view: who may, what was drawn, and the action that records it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form
from fastapi.responses import RedirectResponse

from service.jobs.surfaces import fuse
from service.people.control import Control
from service.run_acts import read_region, step_to_draw_for
from service.run_record import RunRecord
from service.web.run.forms import RunId
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite

router = APIRouter(tags=["scene"])


@dataclass(frozen=True, slots=True)
class DrawnRow:
    """A region that a person drew, for the page."""

    by: str
    source: str
    corners: int
    used: bool  # by the fusion whose result the run has


def drawn_rows(log: RunRecord) -> tuple[DrawnRow, ...]:
    """The regions drawn in a run, oldest first."""
    rows: list[DrawnRow] = []
    for found in log.state.drawn:
        jobs = log.state.steps[found.region.step].jobs.values()
        used = any(
            job.kind == fuse.KIND.name and job.status == "finished" and job.enqueued_seq > found.seq for job in jobs
        )
        rows.append(DrawnRow(found.by, found.region.source, len(found.region.corners_m), used))
    return tuple(rows)


@router.post("/runs/{run_id}/scene/region", name="draw_region", dependencies=[Depends(requires("operate"))])
def draw_region(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    source: Annotated[Literal["ct", "scan"], Form()],
    corners: Annotated[str, Form(max_length=40_000)],
    along: Annotated[str, Form(max_length=400)],
) -> RedirectResponse:
    """Record a polygon that was drawn on the 3D view: corners and direction in the frame of the scan, metres."""
    log = site.run(run_id)
    Control(site.store).require(run_id, person)
    region = read_region(step_to_draw_for(log), source, corners, along)
    site.store.record(run_id, [region], actor=person.account)
    return RedirectResponse(f"/runs/{run_id}/scene", status_code=303)
