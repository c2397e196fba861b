"""What people do to a run: start, tick, confirm, sign, redo, skip, pause, resume, abort; and who has control."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form, Path
from fastapi.responses import RedirectResponse

from service.core.errors import ConfigurationError, IllegalTransitionError
from service.core.protocol.models import load_protocol
from service.core.records.entered import NoteTaken, about_run
from service.core.records.events import (
    ActionRefused,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
    ItemTicked,
    JobEnqueued,
    JobFailed,
    JobFinished,
    OperatorAction,
    OperatorVerb,
    SessionStarted,
    StepNote,
    View,
)
from service.core.recovery.reasons import full_reason
from service.core.run.actions import needs_leave, refuse
from service.core.run.state import RunState
from service.people.approvals import approve, standing_of
from service.people.authorisation import identity_for
from service.people.control import Control
from service.people.errors import NotAllowedError
from service.people.sessions import NAMES, KnownBy
from service.rig import load_rig
from service.run_record import RunRecord
from service.run_start import record_refusal, require_rig_free, start_run
from service.steps import params_models
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["acting"])

RunId = Annotated[str, Path(max_length=64)]
Short = Annotated[str, Form(max_length=200)]
Words = Annotated[str, Form(max_length=2000)]
Secret = Annotated[str, Form(max_length=1000)]
Number = Annotated[int, Form(ge=0, le=2**31)]
# Events that change nothing of what the person was looking at when deciding.
_HARMLESS = (
    NoteTaken,
    ActionRefused,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
    ItemTicked,
    JobEnqueued,
    JobFailed,
    JobFinished,
    SessionStarted,
    StepNote,
    View,
)


@router.post("/runs", name="start_run", dependencies=[Depends(requires("operate"))])
def start(
    site: CurrentSite,
    person: SignedInPerson,
    protocol: Short,
    reason: Words = "",
    password: Secret = "",
    specimen: Words = "",
    purpose: Words = "",
    place: Annotated[str, Form(alias="site", max_length=2000)] = "",
    operator: Words = "",
    text: Annotated[str, Form(max_length=20_000)] = "",
) -> RedirectResponse:
    """Begin a run of one of the protocol files; nothing moves before somebody confirms.

    Whoever is the first to begin one approves its content. A content that is not the approved one of its id and
    version needs a reason, and the password of somebody who may sign.
    """
    about = about_run(specimen=specimen, purpose=purpose, site=place, operator=operator, text=text)
    known = {path.name: path for path in site.protocol_files()}
    if protocol not in known:
        raise ConfigurationError(
            f"there is no protocol file {protocol!r}", where=str(site.protocols), remedy="Reload the page"
        )
    loaded = load_protocol(known[protocol], params_models())
    require_rig_free(site.store, site.rig.path)
    changed = standing_of(site.store, loaded).changed
    if changed:
        if not person.may("sign"):
            raise NotAllowedError(f"the role {person.role} may not approve a changed protocol", where=protocol)
        if reason.strip():
            site.people.check_password(person.account, password)
    approve(site.store, loaded, person.account, reason=reason, identified="password" if changed else "")
    rig = load_rig(site.rig.path)
    run_id = start_run(site.store, loaded, rig, operator=person.account, auto_confirm=False, about=about)
    Control(site.store).take(run_id, person)
    site.launcher.start(run_id)
    return _back(run_id)


@router.post("/runs/{run_id}/go-on", name="go_on", dependencies=[Depends(requires("operate"))])
def go_on(site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Start the process that drives the run again, after it ended."""
    log = site.run(run_id)
    if log.state.terminal:
        raise IllegalTransitionError(f"the run is {log.state.status}", where=run_id)
    Control(site.store).require(run_id, person)
    site.launcher.start(run_id)
    return _back(run_id)


@router.post("/runs/{run_id}/ticks", name="tick", dependencies=[Depends(requires("operate"))])
def tick(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    step: Short,
    attempt: Number,
    item: Words,
    ticked: Annotated[bool, Form()],
) -> RedirectResponse:
    """Mark a checklist item; every screen shows the same."""
    log = site.run(run_id)
    Control(site.store).require(run_id, person)
    now = log.state.step
    asked = now.phase in ("ready", "recovering") or needs_leave(log.protocol, log.state)
    if log.state.terminal or (step, attempt) != (now.step, now.attempt) or not asked:
        raise _out_of_date(log.state)
    if item not in log.protocol.step(step).checklist:
        raise IllegalTransitionError("there is no such item in the checklist", where=step)
    if (item in now.ticked) != ticked:
        site.store.record(
            run_id, [ItemTicked(step=step, attempt=attempt, item=item, ticked=ticked)], actor=person.account
        )
    return _back(run_id)


@router.post(
    "/runs/{run_id}/actions", name="act", dependencies=[Depends(requires("operate", while_locked=("pause",)))]
)
def act(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    verb: Annotated[OperatorVerb, Form()],
    step: Short = "",
    attempt: Number = 0,
    viewpoint: Short = "",
    preset: Words = "",
    reason: Words = "",
    meaning: Words = "",
    known_by: Annotated[KnownBy, Form()] = "password",
    password: Secret = "",
    account: Short = "",
    signed_sha256: Short = "",
    seen_seq: Number = 0,
    back: Annotated[Literal["", "capture"], Form()] = "",
) -> RedirectResponse:
    """Append what the person does if it is allowed now; otherwise append the refusal and say why.

    `password` holds what `known_by` names: the password, or the PIN or badge where the site lets them sign.
    Pausing needs neither control of the run nor an unlocked screen: it is the safe direction.
    """
    log = site.run(run_id)
    if verb != "pause":
        Control(site.store).require(run_id, person)
    if verb in ("confirm", "sign", "skip", "accept"):
        _require_current(log, step, attempt, seen_seq)
    if verb == "sign":
        if not person.may("sign"):
            raise NotAllowedError(f"the role {person.role} may not sign", where=run_id)
        _require_accepted(site, known_by)
        site.people.check_secret(person.account, known_by, password)
    if verb == "accept":
        _require_accepted(site, known_by)
    # A supervisor may accept on the technician's screen, by name and password.
    who = identity_for(
        site.people, log.protocol, log.state, verb, account or person.account, lambda: password, known_by
    )
    action = OperatorAction(
        action=verb,
        step=step or log.state.current,
        viewpoint=viewpoint or None,
        reason=full_reason(preset, reason),
        checklist=log.state.step.ticked if verb == "confirm" else (),
        meaning=meaning.strip(),
        signed_sha256=signed_sha256,
        role=who.role if who else "",
        identified=who.identified if who else known_by if verb == "sign" else "",
        via="web",
    )
    _append(site, log, action, who.name if who else person.account)
    return _back(run_id, back)


def _require_accepted(site: Site, known_by: KnownBy) -> None:
    signing = site.rig.section.signing
    if known_by != "password" and not (signing.pin if known_by == "pin" else signing.badge):
        raise NotAllowedError(
            f"this site takes no {NAMES[known_by]} for a signature", where=known_by, remedy="Give the password"
        )


def _append(site: Site, log: RunRecord, action: OperatorAction, actor: str) -> None:
    refusal = refuse(log.protocol, log.state, action, actor)
    if refusal is not None:
        record_refusal(site.store, log.run_id, log.state, action, refusal, actor)
        raise refusal
    site.store.record(log.run_id, [action], actor=actor)


def _require_current(log: RunRecord, step: str, attempt: int, seen_seq: int) -> None:
    """A page that shows an earlier question must not answer a later one."""
    state = log.state
    since = (event.payload for event in log.events[seen_seq:])
    if (step, attempt) != (state.current, state.step.attempt) or not all(isinstance(p, _HARMLESS) for p in since):
        raise _out_of_date(state)


def _out_of_date(state: RunState) -> IllegalTransitionError:
    return IllegalTransitionError(
        "the page was out of date: the run has gone on since it was shown",
        where=state.current,
        remedy="Read what it shows now and decide again; nothing was done",
    )


# --- control ----------------------------------------------------------------------------------------------------


@router.post("/runs/{run_id}/control/take", name="take_control", dependencies=[Depends(requires("operate"))])
def take_control(site: CurrentSite, person: SignedInPerson, run_id: RunId, reason: Words = "") -> RedirectResponse:
    """Take control of a run that nobody controls; a supervisor takes it from somebody with a reason."""
    _require_open(site, run_id)
    control = Control(site.store)
    if reason.strip():
        control.take_over(run_id, person, reason)
    else:
        control.take(run_id, person)
    return _back(run_id)


@router.post("/runs/{run_id}/control/ask", name="ask_for_control", dependencies=[Depends(requires("operate"))])
def ask_for_control(site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Ask whoever has control to hand it over."""
    _require_open(site, run_id)
    Control(site.store).ask(run_id, person)
    return _back(run_id)


@router.post("/runs/{run_id}/control/answer", name="answer_for_control", dependencies=[Depends(requires("operate"))])
def answer_for_control(
    site: CurrentSite, person: SignedInPerson, run_id: RunId, grant: Annotated[bool, Form()]
) -> RedirectResponse:
    """Hand control over to the screen that asked for it, or keep it."""
    Control(site.store).answer(run_id, person, grant=grant)
    return _back(run_id)


@router.post("/runs/{run_id}/control/release", name="release_control", dependencies=[Depends(requires("operate"))])
def release_control(site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Give control up; the run goes on and waits at its next question."""
    Control(site.store).release(run_id, person)
    return _back(run_id)


def _require_open(site: Site, run_id: str) -> None:
    state = site.run(run_id).state
    if state.terminal:
        raise IllegalTransitionError(f"the run is {state.status}: there is nothing to control any more", where=run_id)


def _back(run_id: str, page: str = "") -> RedirectResponse:
    return RedirectResponse(f"/runs/{run_id}/{page}".rstrip("/"), status_code=303)
