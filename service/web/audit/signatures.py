"""The auditor's pages of who signed what, and of whether the evidence verifies."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from service.audit.background import PartialProgress
from service.audit.overview import first_page
from service.audit.overview.signatures import signatures
from service.web.audit.frame import CurrentAudit, audit_frame
from service.web.page.rendering import render
from service.web.security.guards import SignedInPerson, requires

router = APIRouter(tags=["audit"])
_READ = [Depends(requires("read"))]


@router.get(
    "/audit/runs/{run_id}/signatures", name="audit_signatures", dependencies=_READ, response_class=HTMLResponse
)
def signatures_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """Show who signed what, and whether the signature is still valid."""
    frame = audit_frame(audit, run_id, "/signatures")
    digest = audit.digests.get(run_id)
    known = first_page.known(digest)
    with audit.site.store.database.reading() as connection:
        found = signatures(connection, run_id, known)
    return render(
        request,
        "audit/signatures.html.j2",
        audit=frame,
        signatures=found,
        digest=known,
        progress=digest if isinstance(digest, PartialProgress) else None,
    )


@router.get(
    "/audit/runs/{run_id}/verification", name="audit_verification", dependencies=_READ, response_class=HTMLResponse
)
def verification_page(request: Request, audit: CurrentAudit, run_id: str) -> Response:
    """What the last verification found, or how far the current one is."""
    return render(request, "audit/verification.html.j2", audit=audit_frame(audit, run_id, "/verification"))


@router.post("/audit/runs/{run_id}/verification", name="verify", dependencies=_READ)
def verify_now(
    audit: CurrentAudit, person: SignedInPerson, run_id: str, back: Annotated[Literal["", "exports"], Form()] = ""
) -> Response:
    """Verify the run. It only reads, so everybody who may read may start it."""
    audit_frame(audit, run_id, "/verification")
    audit.verifications.start(run_id, person.account)
    shown = f"/runs/{run_id}/exports" if back else f"/audit/runs/{run_id}/verification"
    return RedirectResponse(shown, status_code=303)
