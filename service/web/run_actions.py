"""What people do to a run: start, tick, confirm, sign, redo, skip, pause, resume, abort, and take control of it."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Form, Path
from fastapi.responses import RedirectResponse
from pydantic import BaseModel, Field

from service.core.errors import ConfigurationError, IllegalTransitionError
from service.core.protocol import full_reason, load_protocol
from service.core.records.entered import REASON_CHARACTERS, NoteTaken, about_run, reason_of, require_specimen
from service.core.records.run_events import (
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
    RecordedView,
    RobotSeen,
    SessionStarted,
    StepNote,
)
from service.core.run.actions import redo_moves, refuse
from service.core.run.state import RunState, lost_arms
from service.followed_run import RunRecord
from service.people.approvals import approve, standing_of
from service.people.control import Control
from service.people.credentials import on_screen_of
from service.people.person import NotAllowedError
from service.people.sessions import NAMES, Identity, KnownBy, identity_for
from service.rig import load_rig
from service.run_acts import DECIDE_AGAIN, cancel_computation, out_of_date, see_robot, tick_item
from service.run_start import record_refusal, require_rig_free, require_runnable, start_run
from service.steps import params_models
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, RunId, Site

Reason = Annotated[str, Form(max_length=REASON_CHARACTERS)]


class StartForm(BaseModel):
    """The form that starts a run: a protocol file, and what people enter about the run, which must name the specimen.

    A protocol whose content was changed without a new version also needs a reason and a password.
    """

    protocol: str = Field(max_length=200)
    reason: str = Field("", max_length=REASON_CHARACTERS)
    password: str = Field("", max_length=1000)
    specimen: str = Field("", max_length=2000)
    purpose: str = Field("", max_length=2000)
    site: str = Field("", max_length=2000)
    operator: str = Field("", max_length=2000)
    text: str = Field("", max_length=20_000)


class ActionForm(BaseModel):
    """An action on a run.

    Attributes:
        verb: the action.
        step: identifier of the step; "" for the current one.
        current: the step at which the run was, as the page showed it; a redo is of another one.
        attempt: the attempt of that step, as the page showed it.
        viewpoint: the viewpoint that is redone; "" for the whole step.
        replaces: number of the event whose image of the viewpoint the page said is replaced; 0 for none.
        moves: true if the page said that the robot then drives there at once.
        preset: a reason chosen from the list.
        reason: text that is added to it.
        meaning: the meaning of a signature.
        known_by: the kind of secret in `password`: a password, or a PIN or badge where the site allows them to sign.
        password: the secret of the person who acts; `known_by` says of which kind.
        account: the account of the person who accepts, where that is not the person who is signed in.
        signed_sha256: hash of the record that a signature or acceptance binds.
        seen_seq: number of the last event that the page showed.
        back: page to return to; "" for the run's page.
    """

    verb: OperatorVerb
    step: str = Field("", max_length=200)
    current: str = Field("", max_length=200)
    attempt: int = Field(0, ge=0, le=2**31)
    viewpoint: str = Field("", max_length=200)
    replaces: int = Field(0, ge=0, le=2**31)
    moves: bool = False
    preset: str = Field("", max_length=2000)
    reason: str = Field("", max_length=REASON_CHARACTERS)
    meaning: str = Field("", max_length=2000)
    known_by: KnownBy = "password"
    password: str = Field("", max_length=1000)
    account: str = Field("", max_length=200)
    signed_sha256: str = Field("", max_length=200)
    seen_seq: int = Field(0, ge=0, le=2**31)
    back: Literal["", "capture"] = ""


def back_to(run_id: str, page: str = "") -> RedirectResponse:
    """Show a page of a run after a form was sent; "" is the run's own page."""
    return RedirectResponse(f"/runs/{run_id}/{page}".rstrip("/"), status_code=303)


router = APIRouter(tags=["acting"])

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


Short = Annotated[str, Form(max_length=200)]
Words = Annotated[str, Form(max_length=2000)]
Number = Annotated[int, Form(ge=0, le=2**31)]
_WITHOUT_CONTROL = ("pause", "sign", "accept")
# Events that change nothing on the page on which the person decided.
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
    RobotSeen,
    SessionStarted,
    StepNote,
    RecordedView,
)


@router.post("/runs", name="start_run", dependencies=[Depends(requires("operate"))])
def start(
    site: CurrentSite,
    person: SignedInPerson,
    form: Annotated[StartForm, Form()],
) -> RedirectResponse:
    """Begin a run of one of the protocol files; nothing moves before somebody confirms.

    The first person who begins a run with a protocol approves its content. Content that differs from what was
    approved under the same id and version needs a reason, and the password of somebody who may sign.
    """
    about = about_run(
        specimen=form.specimen, purpose=form.purpose, site=form.site, operator=form.operator, text=form.text
    )
    known = {path.name: path for path in site.protocol_files()}
    if form.protocol not in known:
        raise ConfigurationError(
            f"there is no protocol file {form.protocol!r}", where=str(site.protocols), remedy="Reload the page"
        )
    loaded = load_protocol(known[form.protocol], params_models())
    rig = load_rig(site.rig.path)
    require_runnable(loaded, rig, site.devices_of(rig))
    require_specimen(about)
    require_rig_free(site.store, site.rig.path)
    changed = standing_of(site.store, loaded).changed
    if changed:
        if not person.may("sign"):
            raise NotAllowedError(f"the role {person.role} may not approve a changed protocol", where=form.protocol)
        if form.reason.strip():
            site.people.check_password(person.account, form.password, on_screen_of(person))
    approve(site.store, loaded, person.account, reason=form.reason, identified="password" if changed else "")
    run_id = start_run(site.store, loaded, rig, operator=person.account, auto_confirm=False, about=about)
    Control(site.store).take(run_id, person)
    site.launcher.start(run_id)
    return back_to(run_id)


@router.post("/runs/{run_id}/go-on", name="go_on", dependencies=[Depends(requires("operate"))])
def go_on(site: CurrentSite, person: SignedInPerson, run_id: RunId) -> RedirectResponse:
    """Start the process that drives the run again, after it ended."""
    log = site.run(run_id)
    if log.state.terminal:
        raise IllegalTransitionError(f"the run is {log.state.status}", where=run_id)
    Control(site.store).require(run_id, person)
    site.launcher.start(run_id)
    return back_to(run_id)


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
    tick_item(log, step, attempt, item, ticked=ticked, actor=person.account)
    return back_to(run_id)


@router.post("/runs/{run_id}/robot-seen", name="robot_seen", dependencies=[Depends(requires("operate"))])
def robot_seen(
    site: CurrentSite, person: SignedInPerson, run_id: RunId, device: Short, lost_seq: Number
) -> RedirectResponse:
    """Record that the person has looked at an arm whose connection was lost. Nothing moves by it.

    It needs no control of the run: whoever stands where the arm can be seen says it.
    """
    log = site.run(run_id)
    see_robot(log, device, lost_seq, driven=site.launcher.driven(run_id), actor=person.account)
    return back_to(run_id)


@router.post(
    "/runs/{run_id}/actions", name="act", dependencies=[Depends(requires("operate", while_locked=("pause",)))]
)
def act(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    form: Annotated[ActionForm, Form()],
) -> RedirectResponse:
    """Append what the person does if it is allowed now; otherwise append the refusal and say why.

    Pausing needs neither control of the run nor an unlocked screen, because it can only make the run safer. A
    signature and an acceptance need no control: they are a person's word on figures, and nothing moves by them.
    """
    log = site.run(run_id)
    if form.verb not in _WITHOUT_CONTROL:
        Control(site.store).require(run_id, person)
    if not log.state.terminal:  # else it is refused, and recorded as an action after the end
        _require_shown(log, form)
    if form.verb == "sign":
        if not person.may("sign"):
            raise NotAllowedError(f"the role {person.role} may not sign", where=run_id)
        _require_signing_with(site, form.known_by)
        site.people.check_secret(person.account, form.known_by, form.password, on_screen_of(person))
    if form.verb == "accept":
        _require_signing_with(site, form.known_by)
    # A supervisor may accept on the technician's screen, by name and password.
    account = form.account or person.account
    who = identity_for(
        site.people,
        log.protocol,
        log.state,
        form.verb,
        account,
        lambda: form.password,
        form.known_by,
        on_screen_of(person),
    )
    _append(site, log, _action(form, log.state, who), who.name if who else person.account)
    return back_to(run_id, form.back)


@router.post("/runs/{run_id}/jobs/{job}/cancel", name="cancel_job", dependencies=[Depends(requires("operate"))])
def cancel(
    site: CurrentSite,
    person: SignedInPerson,
    run_id: RunId,
    job: Annotated[str, Path(max_length=64)],
    reason: Reason,
) -> RedirectResponse:
    """End a computation with a reason; nothing else of the run is touched."""
    site.run(run_id)
    Control(site.store).require(run_id, person)
    cancel_computation(site.store, run_id, job, reason, actor=person.account)
    return back_to(run_id)


def _action(form: ActionForm, state: RunState, who: Identity | None) -> OperatorAction:
    """Return the event of a form; `who` is the person who identified themselves for this action, if one had to."""
    reason = full_reason(form.preset, form.reason)
    return OperatorAction(
        action=form.verb,
        step=form.step or state.current,
        viewpoint=form.viewpoint or None,
        reason=reason and reason_of(reason, IllegalTransitionError),
        checklist=state.step.ticked if form.verb == "confirm" else (),
        meaning=form.meaning.strip(),
        signed_sha256=form.signed_sha256,
        role=who.role if who else "",
        identified=who.identified if who else form.known_by if form.verb == "sign" else "",
        via="web",
    )


def _require_signing_with(site: Site, known_by: KnownBy) -> None:
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


def _require_shown(log: RunRecord, form: ActionForm) -> None:
    """Refuse what a person decided about something else than what there is now."""
    if form.verb in ("confirm", "sign", "skip", "accept", "resume"):
        _require_current(log, form.step, form.attempt, form.seen_seq)
    if form.verb in ("confirm", "resume"):
        _require_losses_seen(log, form.seen_seq)
    if form.verb == "redo":
        _require_same_redo(log, form)


def _require_current(log: RunRecord, step: str, attempt: int, seen_seq: int) -> None:
    """Refuse the answer of a page that shows an earlier question."""
    state = log.state
    since = (event.payload for event in log.events[seen_seq:])
    if (step, attempt) != (state.current, state.step.attempt) or not all(isinstance(p, _HARMLESS) for p in since):
        raise out_of_date(state)


def _require_same_redo(log: RunRecord, form: ActionForm) -> None:
    """Refuse a redo that differs from what its form said: the run's place, the image, whether the robot moves."""
    state = log.state
    if (form.current, form.attempt) != (state.current, state.step.attempt):
        raise out_of_date(state)
    if not form.viewpoint or form.step not in state.steps:
        return
    image = state.steps[form.step].captured.get(form.viewpoint, 0)
    moves = redo_moves(log.protocol, log.state, form.step)
    if form.replaces != image:
        what = f"{form.viewpoint} has another image by now" if image else f"{form.viewpoint} has no image any more"
    elif form.moves != moves:
        how = "drive" if moves else "not drive"
        what = f"the robot would {how} to {form.viewpoint} at once, which the form did not say"
    else:
        return
    raise IllegalTransitionError(what, where=form.step, remedy=DECIDE_AGAIN)


def _require_losses_seen(log: RunRecord, seen_seq: int) -> None:
    """Refuse to let the robot move if the page did not show every arm whose connection was lost."""
    moves = log.protocol.step(log.state.current).moves_robot
    if moves and any(loss.seq > seen_seq for loss in lost_arms(log.state).values()):
        raise out_of_date(log.state)
