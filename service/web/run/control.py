"""Control of a run: one screen at a time has it; others take it, ask for it, hand it over or give it up."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Form
from fastapi.responses import RedirectResponse

from service.core.errors import IllegalTransitionError
from service.people.control import Control
from service.web.run.forms import Reason, RunId, back_to
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["control"])

Shown = Annotated[str, Form(max_length=64)]  # the screen of which the page spoke; "" for none


@router.post("/runs/{run_id}/control/take", name="take_control", dependencies=[Depends(requires("operate"))])
def take_control(
    site: CurrentSite, person: SignedInPerson, run_id: RunId, reason: Reason = "", holder: Shown = ""
) -> RedirectResponse:
    """Take control of a run that nobody controls; a supervisor takes it from somebody with a reason."""
    _require_open(site, run_id)
    control = Control(site.store)
    if reason.strip():
        control.take_over(run_id, person, reason, shown=holder)
    else:
        control.take(run_id, person, shown=holder)
    return back_to(run_id)


@router.post("/runs/{run_id}/control/ask", name="ask_for_control", dependencies=[Depends(requires("operate"))])
def ask_for_control(site: CurrentSite, person: SignedInPerson, run_id: RunId, holder: Shown = "") -> RedirectResponse:
    """Ask the one who has control to hand it over."""
    _require_open(site, run_id)
    Control(site.store).ask(run_id, person, shown=holder)
    return back_to(run_id)


@router.post("/runs/{run_id}/control/answer", name="answer_for_control", dependencies=[Depends(requires("operate"))])
def answer_for_control(
    site: CurrentSite, person: SignedInPerson, run_id: RunId, grant: Annotated[bool, Form()], asker: Shown = ""
) -> RedirectResponse:
    """Hand control over to the screen that asked for it, or keep it."""
    Control(site.store).answer(run_id, person, grant=grant, shown=asker)
    return back_to(run_id)


@router.post("/runs/{run_id}/control/release", name="release_control", dependencies=[Depends(requires("operate"))])
def release_control(site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Give control up; the run goes on and waits at its next question."""
    Control(site.store).release(run_id, person)
    return back_to(run_id)


def _require_open(site: Site, run_id: str) -> None:
    state = site.run(run_id).state
    if state.terminal:
        raise IllegalTransitionError(f"the run is {state.status}: there is nothing to control any more", where=run_id)
