"""The page of a run's data set, its pictures, and its coloured surfaces."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, HTTPException, Path, Query, Request, Response
from fastapi.responses import FileResponse, HTMLResponse, RedirectResponse

from service.core.gates.release import refuse_data_set
from service.web.dataset.benchmark import FOLDER, benchmark_of
from service.web.dataset.previews import CurrentPreviews
from service.web.dataset.view import data_set_view
from service.web.page.rendering import render
from service.web.page.run_frame import run_frame
from service.web.record.images import further_cameras_of
from service.web.scene.pages import FRAME_HEADERS, Theme
from service.web.security.guards import requires
from service.web.site import CurrentSite

router = APIRouter(tags=["dataset"])

RunId = Annotated[str, Path(max_length=64)]
Split = Annotated[Literal["dense", "sparse", "train", "test"], Query()]
_READ = [Depends(requires("read"))]
_TYPES = {"jpg": "image/jpeg", "webp": "image/webp"}
_TITLES = {
    "coverage": "Coverage in 3D",
    "sources": "Sources of the ground truth in 3D",
    "sigmas": "Standard deviation of the ground truth in 3D",
    "distances": "Distance of the scan to the CT in 3D",
}


@router.get("/runs/{run_id}/dataset", name="data_set", dependencies=_READ, response_class=HTMLResponse)
def data_set_page(
    request: Request,
    site: CurrentSite,
    previews: CurrentPreviews,
    run_id: RunId,
    split: Split = "dense",
    view: Annotated[str, Query(max_length=200)] = "",
) -> Response:
    """Views, crops, depth, coverage and distances, as far as they are ready; the rest is made meanwhile."""
    log = site.run(run_id)
    unfit = refuse_data_set(log.state)
    preview = None if unfit else previews.ready(log.state)
    return render(
        request,
        "dataset/dataset.html.j2",
        frame=run_frame(site, run_id),
        run_id=run_id,
        unfit=unfit,
        preview=preview,
        making=None if unfit else previews.making(run_id),
        benchmark=benchmark_of(site.data, log.events),
        benchmark_folder=site.data / FOLDER,
        further=further_cameras_of(log),
        shown=None if preview is None else data_set_view(preview, split, view),
    )


@router.post("/runs/{run_id}/dataset", name="make_preview", dependencies=_READ)
def make_preview(site: CurrentSite, previews: CurrentPreviews, run_id: RunId) -> RedirectResponse:
    """Make the pictures again, after that has failed."""
    log = site.run(run_id)
    unfit = refuse_data_set(log.state)
    if unfit is not None:
        raise unfit
    previews.make(log.state)
    return RedirectResponse(f"/runs/{run_id}/dataset", status_code=303)


@router.get("/runs/{run_id}/dataset/pictures/{name}", name="data_set_picture", dependencies=_READ)
def picture(
    site: CurrentSite, previews: CurrentPreviews, run_id: RunId, name: Annotated[str, Path(max_length=80)]
) -> FileResponse:
    """A picture of the preview."""
    path = previews.file(site.run(run_id).state, name)
    if path is None or path.suffix[1:] not in _TYPES:
        raise HTTPException(404, "the data set has no such picture")
    headers = {"Cache-Control": "private, max-age=3600", "X-Content-Type-Options": "nosniff"}
    return FileResponse(path, media_type=_TYPES[path.suffix[1:]], headers=headers)


@router.get("/runs/{run_id}/dataset/{figure}/frame", name="data_set_frame", dependencies=_READ)
def surface_frame(
    request: Request,
    site: CurrentSite,
    previews: CurrentPreviews,
    run_id: RunId,
    figure: Literal["coverage", "sources", "sigmas", "distances"],
    theme: Theme = "auto",
) -> HTMLResponse:
    """A coloured surface alone, for its sandboxed frame."""
    path = previews.file(site.run(run_id).state, f"{figure}.json")
    if path is None:
        raise HTTPException(404, "this surface is not ready")
    text = path.read_text(encoding="utf-8")
    response = render(
        request,
        "scene/frame.html.j2",
        figure=text,
        theme=theme,
        stations=[],
        title=_TITLES[figure],
        to_view=None,
    )
    response.headers.update(FRAME_HEADERS)
    return response
