"""Drawing a region of the ground truth on the 3D view: who may, what was drawn, and the action that records it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, TypeVar

from fastapi import APIRouter, Depends, Form
from fastapi.responses import RedirectResponse
from pydantic import TypeAdapter, ValidationError

from service.core.errors import ConfigurationError, IllegalTransitionError
from service.core.records.events import RegionDrawn
from service.dataset.registrations import best_registration
from service.jobs.surfaces import fuse
from service.people.control import Control
from service.run_record import RunRecord
from service.web.run.forms import RunId
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite

router = APIRouter(tags=["scene"])

_T = TypeVar("_T")
_Point = tuple[float, float, float]
_CORNERS = TypeAdapter(tuple[_Point, ...])
_POINT = TypeAdapter(_Point)
_MOST_CORNERS, _FARTHEST_M = 200, 10.0


@dataclass(frozen=True, slots=True)
class DrawnRow:
    """A region that a person drew, for the page."""

    by: str
    source: str
    corners: int
    used: bool  # by the fusion whose result the run has


def drawing_step(log: RunRecord) -> str:
    """The step for whose next fusion a region can be drawn now; "" if there is none.

    It needs the registered scene, in whose frame the region is, and a run that has not ended.
    """
    if log.state.terminal or best_registration(log.protocol, log.state) is None:
        return ""
    return next((step.id for step in log.protocol.steps if step.gives == "ground_truth"), "")


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
    step = drawing_step(log)
    if not step:
        raise IllegalTransitionError(
            "no region can be drawn now",
            where="3D view",
            remedy="Draw it after the registration, before the run ends",
        )
    site.store.record(run_id, [read_region(step, source, corners, along)], actor=person.account)
    return RedirectResponse(f"/runs/{run_id}/scene", status_code=303)


def read_region(step: str, source: Literal["ct", "scan"], corners: str, along: str) -> RegionDrawn:
    """The region of the form's fields. Raises ConfigurationError if they are not a polygon on the scene."""
    return RegionDrawn(step=step, source=source, corners_m=_read_corners(corners), seen_along=_read_direction(along))


def _read_corners(text: str) -> tuple[_Point, ...]:
    corners = _read(_CORNERS, text)
    near = all(abs(value) <= _FARTHEST_M for corner in corners for value in corner)
    if not 3 <= len(corners) <= _MOST_CORNERS or not near:
        raise _unusable(f"{len(corners)} corners are not a polygon on this scene")
    return corners


def _read_direction(text: str) -> _Point:
    direction = _read(_POINT, text)
    if not 1e-6 < math.hypot(*direction) < 1e6:  # nor is it not a number
        raise _unusable("the polygon has no direction")
    return direction


def _read(kind: TypeAdapter[_T], text: str) -> _T:
    try:
        return kind.validate_json(text)
    except ValidationError as error:
        raise _unusable("the drawn polygon cannot be read") from error


def _unusable(what: str) -> ConfigurationError:
    return ConfigurationError(what, where="3D view", remedy="Draw it again, with at least three corners")
