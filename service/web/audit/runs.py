"""The auditor's list of runs, filtered and searched."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, Response

from service.audit.background import PartialProgress
from service.audit.overview import first_page
from service.audit.overview.first_page import ListedRun
from service.audit.record import rows
from service.audit.runs.search import RunSearch, find_runs
from service.web.audit.frame import AuditState, CurrentAudit, link
from service.web.audit.queries import RunQuery
from service.web.page.rendering import render
from service.web.security.guards import requires

router = APIRouter(tags=["audit"])
_READ = [Depends(requires("read"))]
_RUNS_A_PAGE = 25


@router.get("/audit", name="audit", dependencies=_READ, response_class=HTMLResponse)
def runs_page(request: Request, audit: CurrentAudit, query: Annotated[RunQuery, Query()]) -> Response:
    """The runs, newest first."""
    wanted = query.wanted()
    with audit.site.store.database.reading() as connection:
        every = rows.runs(connection)
    said = {run.run_id for run in find_runs(audit.site.store, RunSearch(q=wanted.q))}
    listed = [_listed(audit, basics) for basics in every]
    found = [run for run in listed if run.basics.run_id in said and first_page.matches(run, wanted)]
    pages = max(1, -(-len(found) // _RUNS_A_PAGE))
    page = min(max(query.page, 1), pages)
    return render(
        request,
        "audit/runs.html.j2",
        runs=found[(page - 1) * _RUNS_A_PAGE : page * _RUNS_A_PAGE],
        count=len(found),
        every=len(every),
        unknown=sum(run.digest is None for run in found),
        protocols=sorted({run.protocol for run in every if run.protocol}),
        people=first_page.people_of(listed),
        wanted=wanted,
        page=page,
        pages=pages,
        href=lambda number: link("/audit", {**wanted.query(), "page": number}),
    )


def _listed(audit: AuditState, basics: rows.RunBasics) -> ListedRun:
    digest = audit.digests.at(basics.run_id, basics.head_seq, basics.head_sha256)
    if isinstance(digest, PartialProgress):
        audit.digests.warm(basics.run_id)
    return ListedRun(basics, first_page.known(digest), audit.verifications.last(basics.run_id))
