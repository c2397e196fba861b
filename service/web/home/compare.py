"""The page on which two runs stand side by side."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse

from service.audit.runs.comparison import ComparedRun, compare_runs, root_of
from service.audit.runs.search import RunSearch, find_runs
from service.core.gates.measure_names import measure_name
from service.web.page.rendering import render
from service.web.security.guards import requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["compare"])
_OFFERED = 200  # runs to choose from


@router.get("/compare", name="compare", dependencies=[Depends(requires("read"))])
def compare_page(
    request: Request, site: CurrentSite, run: Annotated[list[str] | None, Query(max_length=64)] = None
) -> HTMLResponse:
    """Two runs, or the choice of two. Raises UnknownRunError."""
    chosen = list(dict.fromkeys(run or []))
    comparison = compare_runs(*(_run(site, run_id) for run_id in chosen)) if len(chosen) == 2 else None
    offered = find_runs(site.store, RunSearch())[:_OFFERED]
    missing = [run_id for run_id in chosen if run_id not in {each.run_id for each in offered}]
    return render(
        request,
        "home/compare.html.j2",
        c=comparison,
        chosen=chosen,
        offered=offered,
        missing=missing,
        measure_name=measure_name,
    )


def _run(site: Site, run_id: str) -> ComparedRun:
    log = site.run(run_id)
    root = root_of(log.events)
    source = site.store.artefact_path(root.protocol.sha256, verify=True).read_text("utf-8")
    return ComparedRun(run_id, root, log.protocol, source, tuple(log.events), log.state)
