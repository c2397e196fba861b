"""The files of a run: every one, where it came from, and what came from what."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.background import PartialProgress
from service.audit.provenance import draw, origin
from service.audit.record import search
from service.jobs.words import term
from service.web.audit.frame import CurrentAudit, audit_frame, link
from service.web.audit.queries import ArtefactQuery
from service.web.page.rendering import render
from service.web.security.guards import requires

router = APIRouter(tags=["audit"])
_READ = [Depends(requires("read"))]


@router.get("/audit/runs/{run_id}/artefacts", name="audit_artefacts", dependencies=_READ, response_class=HTMLResponse)
def artefacts_page(
    request: Request, audit: CurrentAudit, run_id: str, query: Annotated[ArtefactQuery, Query()]
) -> Response:
    """Every file of a run."""
    frame = audit_frame(audit, run_id, "/artefacts")
    wanted = query.wanted()
    with audit.site.store.database.reading() as connection:
        found = search.artefacts_page(connection, run_id, wanted, page=query.page)
        facets = search.artefact_facets(connection, run_id)
    return render(
        request,
        "evidence/artefacts.html.j2",
        audit=frame,
        found=found,
        wanted=wanted,
        facets=facets,
        href=lambda number: link(f"{frame.base}/artefacts", {**wanted.query(), "page": number}),
    )


@router.get(
    "/audit/runs/{run_id}/artefacts/{sha256}", name="audit_artefact", dependencies=_READ, response_class=HTMLResponse
)
def artefact_page(request: Request, audit: CurrentAudit, run_id: str, sha256: str) -> Response:
    """Show one file: what it is, where it came from, and what was made from it."""
    frame = audit_frame(audit, run_id, "/artefacts")
    with audit.site.store.database.reading() as connection:
        found = origin(connection, run_id, sha256)
    return render(request, "evidence/artefact.html.j2", audit=frame, origin=found, artefact=found.records[0])


@router.get(
    "/audit/runs/{run_id}/provenance", name="audit_provenance", dependencies=_READ, response_class=HTMLResponse
)
def provenance_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show the provenance graph of a run."""
    frame = audit_frame(audit, run_id, "/provenance")
    graph = audit.graphs.get(run_id)
    known = None if isinstance(graph, PartialProgress) else graph
    return render(
        request,
        "evidence/provenance.html.j2",
        audit=frame,
        progress=graph if isinstance(graph, PartialProgress) else None,
        graph=known,
        drawing=draw(known) if known else None,
        term=term,
    )
