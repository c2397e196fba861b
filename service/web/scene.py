"""The scene in 3D and as tables, and the drawing of a region of the ground truth in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from service.computations import fuse
from service.core.gates import accepted_gates
from service.followed_run import RunRecord
from service.people.control import Control
from service.run_acts import drawing_step, read_region, step_to_draw_for
from service.web.rendering import render
from service.web.run_frame import run_frame
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, RunId

router = APIRouter(tags=["scene"])


@dataclass(frozen=True, slots=True)
class DrawnRow:
    """A region that a person drew, for the page."""

    by: str
    source: str
    corners: int
    used: bool  # used by the fusion whose result the run has


def drawn_rows(log: RunRecord) -> tuple[DrawnRow, ...]:
    """Return the regions drawn in a run, oldest first."""
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


Theme = Annotated[Literal["auto", "light", "dark"], Query()]
# For documents in a sandboxed frame, which has its own origin, gets no cookies and loads nothing from elsewhere.
# plotly compiles JavaScript at run time for its shaders, hence 'unsafe-eval'.
FRAME_HEADERS = {
    "Content-Security-Policy": "; ".join(
        (
            "sandbox allow-scripts",
            "default-src 'none'",
            "script-src 'self' 'unsafe-eval'",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'self'",
        )
    )
}


@router.get("/runs/{run_id}/scene", name="scene", dependencies=[Depends(requires("read"))])
def scene(request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId) -> HTMLResponse:
    """Show the 3D view in its frame, and everything in it as tables."""
    from service.web.scene_data import scene_tables  # noqa: PLC0415 - mesh and matching, not needed to start

    log = site.run(run_id)
    tables = scene_tables(log, site.data)
    return render(
        request,
        "scene/scene.html.j2",
        frame=run_frame(site, run_id),
        run_id=run_id,
        tables=tables,
        depends=accepted_gates(log.protocol, log.state),
        live=not log.state.terminal,
        drawing=drawing_step(log) if person.may("operate") else "",
        in_control=Control(site.store).holder(run_id).screen == person.screen,
        drawn=drawn_rows(log),
    )


@router.get("/runs/{run_id}/scene/frame", name="scene_frame", dependencies=[Depends(requires("read"))])
def scene_frame(
    request: Request, site: CurrentSite, person: SignedInPerson, run_id: RunId, theme: Theme = "auto"
) -> HTMLResponse:
    """Show the 3D view alone, for the sandboxed frame."""
    from service.dataset.scene_view import scene_json, viewing_frame  # noqa: PLC0415 - as above
    from service.web.scene_data import scene_of, with_mesh  # noqa: PLC0415

    log = site.run(run_id)
    now = scene_of(log)
    whole = with_mesh(now, log, site.data)
    drawing = bool(person.may("operate") and drawing_step(log))
    response = render(
        request,
        "scene/frame.html.j2",
        figure=scene_json(whole),
        theme=theme,
        stations=sorted(now.scene.bases),
        title="Scene in 3D",
        to_view=viewing_frame(whole).tolist() if drawing else None,
    )
    response.headers.update(FRAME_HEADERS)
    return response
