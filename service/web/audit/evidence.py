"""The events of a run and of the site as they were recorded, and its files: where each came from."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.background import PartialProgress
from service.audit.overview import findings
from service.audit.overview.findings import correctable
from service.audit.provenance import draw, origin
from service.audit.record import rows, search
from service.jobs import term
from service.store.records import SITE
from service.web.audit.frame import ArtefactQuery, AuditState, CurrentAudit, EventQuery, audit_frame, link
from service.web.page.rendering import render
from service.web.security import SignedInPerson, requires

router = APIRouter(tags=["audit"])
_READ = [Depends(requires("read"))]


@router.get("/audit/runs/{run_id}/timeline", name="audit_timeline", dependencies=_READ, response_class=HTMLResponse)
def timeline_page(
    request: Request, audit: CurrentAudit, run_id: str, query: Annotated[EventQuery, Query()]
) -> Response:
    """Show the events of a run in order, filtered and searched."""
    frame = audit_frame(audit, run_id, "/timeline")
    return _events(request, audit, run_id, query, "audit/timeline.html.j2", audit=frame)


def _events(
    request: Request,
    here: AuditState,
    chain: str,
    query: EventQuery,
    template: str,
    **context: Any,
) -> Response:
    digest = here.digests.get(chain) if chain != SITE else None
    with here.site.store.database.reading() as connection:
        facets = digest.facets if digest is not None and not isinstance(digest, PartialProgress) else search.Facets()
        last, _ = rows.head(connection, chain)
        if chain == SITE:
            facets.add(connection, SITE, 0, last)
        counted = facets.matching(query) if facets.kinds else None
        page = search.events_page(connection, chain, query, after=query.after, before=query.before, counted=counted)
        devices = search.artefact_facets(connection, chain)["device"]
    address = request.url.path
    return render(
        request,
        template,
        events=page,
        wanted=query,
        facets=facets,
        devices=sorted({*facets.devices, *devices}),
        progress=digest if isinstance(digest, PartialProgress) else None,
        last=last,
        earlier=link(address, {**query.query(), "before": page.before}) if page.before else "",
        later=link(address, {**query.query(), "after": page.after}) if page.after else "",
        **context,
    )


@router.get("/audit/runs/{run_id}/events/{seq}", name="audit_event", dependencies=_READ, response_class=HTMLResponse)
def event_page(request: Request, audit: CurrentAudit, person: SignedInPerson, run_id: str, seq: int) -> Response:
    """Show one event with everything that is recorded of it."""
    frame = audit_frame(audit, run_id, "/timeline")
    return _event(request, audit, run_id, seq, may_correct=person.may("correct"), audit=frame)


def _event(
    request: Request, here: AuditState, chain: str, seq: int, *, may_correct: bool, **context: Any
) -> Response:
    with here.site.store.database.reading() as connection:
        row = rows.one_event(connection, chain, seq)
        last, _ = rows.head(connection, chain)
        brought = search.artefacts_of_events(connection, chain, [row.seq])
    return render(
        request,
        "audit/event.html.j2",
        event=row,
        last=last,
        computed_sha256=rows.computed_sha256(chain, row),
        brought=brought,
        fields=correctable(row.payload) if may_correct and row.kind != "record_corrected" else [],
        events_at=f"/audit/runs/{chain}/events" if chain != SITE else "/audit/site/events",
        **context,
    )


@router.get("/audit/site", name="audit_site", dependencies=_READ, response_class=HTMLResponse)
def site_page(request: Request, audit: CurrentAudit, query: Annotated[EventQuery, Query()]) -> Response:
    """Show the site's chain: starts of the service, people, keys."""
    with audit.site.store.database.reading() as connection:
        starts = findings.events_of(connection, SITE, "service_started", newest=True)[-5:]
        keys = findings.events_of(connection, SITE, "key_changed", newest=True)
    return _events(
        request,
        audit,
        SITE,
        query,
        "audit/site.html.j2",
        starts=list(reversed(starts)),
        keys=keys,
    )


@router.get("/audit/site/events/{seq}", name="audit_site_event", dependencies=_READ, response_class=HTMLResponse)
def site_event_page(request: Request, audit: CurrentAudit, seq: int) -> Response:
    """Show one event of the site's chain."""
    return _event(request, audit, SITE, seq, may_correct=False)


@router.get("/audit/runs/{run_id}/artefacts", name="audit_artefacts", dependencies=_READ, response_class=HTMLResponse)
def artefacts_page(
    request: Request, audit: CurrentAudit, run_id: str, query: Annotated[ArtefactQuery, Query()]
) -> Response:
    """Show every file of a run."""
    frame = audit_frame(audit, run_id, "/artefacts")
    with audit.site.store.database.reading() as connection:
        found = search.artefacts_page(connection, run_id, query, page=query.page)
        facets = search.artefact_facets(connection, run_id)
    return render(
        request,
        "audit/artefacts.html.j2",
        audit=frame,
        found=found,
        wanted=query,
        facets=facets,
        href=lambda number: link(f"{frame.base}/artefacts", {**query.query(), "page": number}),
    )


@router.get(
    "/audit/runs/{run_id}/artefacts/{sha256}", name="audit_artefact", dependencies=_READ, response_class=HTMLResponse
)
def artefact_page(request: Request, audit: CurrentAudit, run_id: str, sha256: str) -> Response:
    """Show one file: what it is, where it came from, and what was made from it."""
    frame = audit_frame(audit, run_id, "/artefacts")
    with audit.site.store.database.reading() as connection:
        found = origin(connection, run_id, sha256)
    return render(request, "audit/artefact.html.j2", audit=frame, origin=found, artefact=found.records[0])


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
        "audit/provenance.html.j2",
        audit=frame,
        progress=graph if isinstance(graph, PartialProgress) else None,
        graph=known,
        drawing=draw(known) if known else None,
        term=term,
    )
