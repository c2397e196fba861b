"""Live capture: last image, verdicts, plan of the viewpoints, contact sheet, live view."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import HTMLResponse

from service.people.control import Control
from service.people.person import Person
from service.web.page.rendering import part_names, render
from service.web.page.run_frame import run_frame
from service.web.record.board_images import BoardUse, board_uses
from service.web.record.images import Capture, captures_of
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["capture"])

RunId = Annotated[str, Path(max_length=64)]
Name = Annotated[str, Query(max_length=64)]
Page = Annotated[int, Query(ge=1, le=100_000)]
ViewsPage = Annotated[
    int, Query(ge=0, le=100_000, description="of the table; 0: the one that shows where the run is")
]
Seq = Annotated[int, Query(ge=0, le=2**53)]
Parts = Annotated[str, part_names("image", "plan", "sheet")]
SHEET = 60  # images on one page of the contact sheet
LISTED = 200  # viewpoints on one page of the table


@router.get("/runs/{run_id}/capture", name="capture", dependencies=[Depends(requires("read"))])
def capture(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    step: Name = "",
    viewpoint: Name = "",
    seq: Seq = 0,
    page: Page = 1,
    views: ViewsPage = 0,
    replaced: bool = False,
    plain: bool = False,
) -> HTMLResponse:
    """Everything about the images of one step."""
    shown = _shown(site, person, run_id, step, viewpoint, seq, page, views, replaced=replaced, plain=plain)
    return render(request, "capture/capture.html.j2", frame=run_frame(site, run_id), **shown)


@router.get("/runs/{run_id}/capture/parts/{names}", name="capture_parts", dependencies=[Depends(requires("read"))])
def capture_parts(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    names: Parts,
    step: Name = "",
    viewpoint: Name = "",
    seq: Seq = 0,
    page: Page = 1,
    views: ViewsPage = 0,
    replaced: bool = False,
    plain: bool = False,
) -> HTMLResponse:
    """Parts of the page, all of one moment, for the script that keeps it up to date."""
    shown = _shown(site, person, run_id, step, viewpoint, seq, page, views, replaced=replaced, plain=plain)
    return render(request, "capture/parts.html.j2", names=names.split(","), **shown)


def _shown(
    site: Site,
    person: Person,
    run_id: str,
    wanted: str,
    viewpoint: str,
    seq: int,
    page: int,
    listed_page: int,
    *,
    replaced: bool,
    plain: bool,
) -> dict[str, Any]:
    # The planning of viewpoints brings scipy, which the start of the service does not wait for.
    from service.web.capture import plan_drawing  # noqa: PLC0415
    from service.web.capture import view as capture_view  # noqa: PLC0415
    from service.web.record import planned_poses  # noqa: PLC0415
    from service.web.record.known_spheres import best_registration  # noqa: PLC0415

    log = site.run(run_id)
    common = {"run_id": run_id, "steps": capture_view.capture_steps(log.protocol), "log": log}
    step = capture_view.step_to_show(log, wanted)
    if step is None:
        return {**common, "step": None, "held": any(s.kind == "manual_capture" for s in log.protocol.steps)}
    views = capture_view.views_of(log, step)
    everything = captures_of(log, step.id)
    valid = [c for c in everything if c.replaced is None]
    chosen = next((c for c in everything if seq and c.seq == seq), None)
    if chosen is None:
        named = [c for c in valid if c.payload.viewpoint == viewpoint]
        chosen = (named or ([] if viewpoint else valid) or [None])[-1]
    name = viewpoint or ("" if chosen is None else chosen.payload.viewpoint)
    view = next((v for v in views if v.name == name), None)
    uses = board_uses(log.state, log.events, step.id)
    listed = sorted(everything if replaced else valid, key=lambda c: _is_problem(c, uses.get(c.sha256)))  # stable
    pages = max(1, -(-len(listed) // SHEET))
    page = min(page, pages)
    stations = list(dict.fromkeys(v.station for v in views if v.station))
    there = {station: planned_poses.station_of(log, station) for station in stations}
    drawings = [
        plan_drawing.plan_drawing(known, [v for v in views if v.station == station], name)
        for station, known in there.items()
        if known is not None
    ]
    # The page of the table that was asked for, or the one with the viewpoint that is shown or comes next.
    views_pages = max(1, -(-len(views) // LISTED))
    here = next((k for k, v in enumerate(views) if v is view or (view is None and v.state == "next")), 0)
    views_page = min(listed_page or 1 + here // LISTED, views_pages)
    advice, suggestions = capture_view.suggestions_of(log, step)
    counts = {state: sum(v.state == state for v in views) for state in capture_view.WORDS}
    holder = Control(site.store).holder(run_id)
    return {
        **common,
        "step": step,
        "state": log.state.steps[step.id],
        "views": views,
        "rows": views[(views_page - 1) * LISTED : views_page * LISTED],
        "views_page": views_page,
        "views_pages": views_pages,
        "counts": {state: count for state, count in counts.items() if count},
        "words": capture_view.WORDS,
        "tones": capture_view.TONES,
        "drawings": [drawing for drawing in drawings if drawing is not None],
        "capture": chosen,
        "view": view,
        "verdicts": [] if chosen is None else capture_view.verdicts_of(log, step, chosen, valid),
        "sums": [] if chosen is None else capture_view.summary_of(step, chosen),
        "redo": None if view is None else capture_view.redo_of(log, step, view, person.account),
        "in_control": person.may("operate") and holder.screen == person.screen,
        "uses": uses,
        "captures": listed[::-1][(page - 1) * SHEET : page * SHEET],  # newest first
        "replaced_count": len(everything) - len(valid),
        "page": page,
        "pages": pages,
        "advice": advice,
        "suggestions": suggestions,
        "registered": best_registration(log) is not None and (chosen is None or chosen.replaced is None),
        "following": not viewpoint and not seq,
        "query": {
            "step": step.id,
            "viewpoint": viewpoint,
            "seq": seq,
            "views": listed_page,
            "replaced": replaced,
            "plain": plain,
        },
    }


def _is_problem(capture: Capture, use: BoardUse | None) -> bool:
    """Whether something is wrong with an image that has not been replaced."""
    wrong = use.used is False if use is not None else not all(capture.payload.verdicts.values())
    return wrong and capture.replaced is None
