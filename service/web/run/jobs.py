"""Ends one computation of a run; nothing else of the run is touched."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Form, Path
from fastapi.responses import RedirectResponse

from service.core.errors import IllegalTransitionError
from service.people.control import Control
from service.web.run.forms import RunId, back_to
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite

router = APIRouter(tags=["acting"])


@router.post("/runs/{run_id}/jobs/{job}/cancel", name="cancel_job", dependencies=[Depends(requires("operate"))])
def cancel(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    job: Annotated[str, Path(max_length=64)],
    reason: Annotated[str, Form(max_length=200)],
) -> RedirectResponse:
    """End a computation with a reason; the step that waits for it asks what to do, as if it had failed."""
    site.run(run_id)
    Control(site.store).require(run_id, person)
    if not reason.strip():
        raise IllegalTransitionError("a reason is needed", where=job, remedy="Say why the computation is ended")
    site.store.cancel_job(run_id, job, actor=person.account, reason=reason.strip())
    return back_to(run_id)
