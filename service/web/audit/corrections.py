"""The auditor's page of corrections: values, steps and views that were replaced; and how a value is corrected."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from service.audit.background import PartialProgress
from service.audit.overview import findings, first_page
from service.audit.overview.findings import correct
from service.audit.record import rows, search
from service.web.audit.frame import CurrentAudit, audit_frame, link
from service.web.page.rendering import render
from service.web.run.forms import Reason
from service.web.security.guards import SignedInPerson, requires

router = APIRouter(tags=["audit"])
_READ = [Depends(requires("read"))]


@router.get(
    "/audit/runs/{run_id}/corrections", name="audit_corrections", dependencies=_READ, response_class=HTMLResponse
)
def corrections_page(request: Request, audit: CurrentAudit, run_id: str, page: int = 1) -> Response:
    """Old and new: corrected values, steps done again, views taken again."""
    frame = audit_frame(audit, run_id, "/corrections")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    views = findings.replaced_viewpoints(known) if known else []
    pages = max(1, -(-len(views) // rows.PAGE))
    page = min(max(page, 1), pages)
    shown = views[(page - 1) * rows.PAGE : page * rows.PAGE]
    with audit.site.store.database.reading() as connection:
        values = findings.corrected_values(connection, run_id)
        steps = findings.replaced_steps(connection, run_id, known) if known else []
        seqs = sorted({seq for view in shown for seq in (view.old_seq, view.new_seq) if seq})
        pictures = {
            row.seq: row for row in reversed(search.artefacts_of_events(connection, run_id, seqs)) if row.is_picture
        }
        corrected = rows.count_of_kind(connection, run_id, "record_corrected")
    return render(
        request,
        "audit/corrections.html.j2",
        audit=frame,
        progress=digest if isinstance(digest, PartialProgress) else None,
        values=values,
        corrected=corrected,
        steps=steps,
        views=shown,
        view_count=len(views),
        pictures=pictures,
        page=page,
        pages=pages,
        href=lambda number: link(f"{frame.base}/corrections", {"page": number}),
    )


@router.post("/audit/runs/{run_id}/corrections", name="correct", dependencies=[Depends(requires("correct"))])
def correct_value(
    audit: CurrentAudit,
    person: SignedInPerson,
    run_id: str,
    of_seq: Annotated[int, Form(ge=1, le=2**53)],
    field: Annotated[str, Form(min_length=1, max_length=400)],
    new: Annotated[str, Form(max_length=4000)],
    reason: Reason,
) -> Response:
    """Record a correction; the original stays."""
    audit_frame(audit, run_id, "/corrections")
    correct(audit.site.store, run_id, of_seq=of_seq, field=field, new=new, reason=reason, actor=person.account)
    return RedirectResponse(f"/audit/runs/{run_id}/corrections", status_code=303)
