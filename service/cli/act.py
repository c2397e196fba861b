"""`orthocapture act`, `note`, `draw-region` and `cancel`: act on a run that another terminal drives."""

from __future__ import annotations

import getpass
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from service.cli.common import DEFAULT_DATA, DataOption, JsonOption, RunOption, console, print_json, reporting_errors
from service.cli.options import OperatorOption, PasswordOption, acting_person, typed_password
from service.computations import term
from service.core.errors import ConfigurationError, IllegalTransitionError
from service.core.protocol import Protocol
from service.core.records.entered import reason_of
from service.core.records.run_events import CaptureAsked, OperatorAction
from service.core.run.actions import VERBS, capture_refusal, record_to_sign, refuse
from service.core.run.fold import fold
from service.core.run.state import RunState, connected_arms, lost_arms
from service.followed_run import RunRecord, read_log
from service.people.sessions import Identity, People, identity_for, who_acts, who_pauses
from service.run_acts import (
    NotePhotograph,
    cancel_computation,
    read_region,
    require_size,
    see_robot,
    step_to_draw_for,
    take_note,
    tick_item,
)
from service.run_start import record_refusal, recorded_run
from service.store.records import Job
from service.store.store import Store

_OF_A_CAPTURE = ("release", "finish")
_BESIDE_THE_QUESTION = ("tick", "untick", "seen")
ACTS = (*VERBS, *_OF_A_CAPTURE, *_BESIDE_THE_QUESTION)


def act_command(
    verb: Annotated[
        str,
        typer.Argument(
            help="confirm, sign, redo, skip, accept, pause, resume or abort; for a manual capture: release or "
            "finish; tick or untick one item of the checklist; seen: you have looked at an arm that was lost."
        ),
    ],
    run: RunOption = "latest",
    step: Annotated[str | None, typer.Option("--step", help="The step, if it is not the current one.")] = None,
    viewpoint: Annotated[str | None, typer.Option("--viewpoint", help="Redo only this viewpoint.")] = None,
    reason: Annotated[str, typer.Option("--reason", help="Why; required for redo, skip, accept and abort.")] = "",
    meaning: Annotated[str, typer.Option("--meaning", help="What the signature means.")] = "",
    item: Annotated[str, typer.Option("--item", help="The item to tick or untick, or how it begins.")] = "",
    device: Annotated[str, typer.Option("--device", help="The arm that you have looked at.")] = "",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Answer or stop a run that another terminal drives. A confirmation ticks the whole checklist."""
    if verb not in ACTS:
        raise typer.BadParameter(f"{verb!r} is not one of {', '.join(ACTS)}", param_hint="VERB")
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, _ = recorded_run(store, run_id)
        state = fold(protocol, store.events(run_id))
        name = operator or getpass.getuser()
        password = partial(typed_password, name, from_stdin=password_stdin)
        if verb in _OF_A_CAPTURE:
            name = who_acts(People(store), name, password, "operate").name
            asked = CaptureAsked.model_validate(
                {"step": step or state.current, "attempt": state.step.attempt, "what": verb}
            )
            _ask_capture(store, run_id, protocol, state, asked, name)
            _report_recorded(run_id, verb, asked.step, name, json=json)
            return
        if verb in _BESIDE_THE_QUESTION:
            name = who_acts(People(store), name, password, "operate").name
            log = read_log(store, run_id, protocol)
            about = _see(log, device, name) if verb == "seen" else _tick(log, item, name, ticked=verb == "tick")
            _report_recorded(run_id, verb, about, name, json=json)
            return
        identity = _identity(store, protocol, state, verb, name, password)
        name = identity.name
        action = OperatorAction(
            action=verb,
            step=step or state.current,
            viewpoint=viewpoint,
            reason=reason.strip() and reason_of(reason, ConfigurationError),
            checklist=protocol.step(state.current).checklist if verb == "confirm" else (),
            meaning=meaning,
            signed_sha256=signed_by_verb(verb, protocol, state),
            role=identity.role,
            identified=identity.identified,
        )
        refusal = refuse(protocol, state, action, name)
        if refusal is not None:
            record_refusal(store, run_id, state, action, refusal, name)
            raise refusal
        store.record(run_id, [action], actor=name)
        _report_recorded(run_id, verb, action.step, name, json=json)


def _identity(
    store: Store, protocol: Protocol, state: RunState, verb: str, name: str, password: Callable[[], str]
) -> Identity:
    """Identify the person who acts. Pausing is always safe, so anybody may pause without a password."""
    identity = identity_for(People(store), protocol, state, verb, name, password)
    if identity is None and verb == "pause":
        return who_pauses(People(store), name)
    return identity or who_acts(People(store), name, password, "sign" if verb == "sign" else "operate")


def _ask_capture(
    store: Store, run_id: str, protocol: Protocol, state: RunState, asked: CaptureAsked, name: str
) -> None:
    """Ask a manual capture to release the shutter or to finish. Raises IllegalTransitionError."""
    if asked.step not in protocol.step_ids:
        raise IllegalTransitionError(f"there is no step {asked.step!r}", where=asked.what)
    refusal = capture_refusal(protocol, state, asked.step, asked.attempt)
    if refusal is not None:
        raise refusal
    store.record(run_id, [asked], actor=name)


def _tick(log: RunRecord, item: str, actor: str, *, ticked: bool) -> str:
    """Mark the item that begins so, or take the mark back. The item. Raises OrthocaptureError."""
    state = log.state
    found = [each for each in log.protocol.step(state.current).checklist if item and each.startswith(item)]
    if len(found) != 1 and item not in found:
        raise ConfigurationError(
            f"{len(found) or 'no'} items of the checklist begin so",
            where=f"{state.current}: {item!r}",
            remedy="Give --item as it begins",
        )
    tick_item(log, state.current, state.step.attempt, found[0], ticked=ticked, actor=actor)
    return found[0]


def _see(log: RunRecord, device: str, actor: str) -> str:
    """Record that the person has looked at an arm, which has to be named if there are several. Its name."""
    lost = lost_arms(log.state)
    known = tuple(lost) or connected_arms(log.state)
    if not device and len(known) != 1:
        said = f"these arms are: {', '.join(known)}" if known else "no arm is lost or left alone"
        raise ConfigurationError(said, where="--device", remedy="Name the arm that you have looked at")
    name = device or known[0]
    seq = lost[name].seq if name in lost else 0
    see_robot(log, name, seq, driven=log.store.driven(log.run_id), actor=actor)
    return name


def _report_recorded(run_id: str, verb: str, step: str | None, name: str, *, json: bool, seq: int = 0) -> None:
    if json:
        print_json({"run": run_id, "recorded": verb, "step": step} | ({"event": seq} if seq else {}))
    else:
        console.print(f"Recorded: {verb} of {step} by {name}")


def signed_by_verb(verb: str, protocol: Protocol, state: RunState) -> str:
    """Return the SHA-256 of the event that an action binds; "" if the action is not a signature."""
    if verb == "accept":
        return state.step.gates_sha256
    return record_to_sign(protocol, state) if verb == "sign" else ""


def note_command(
    text: Annotated[str, typer.Argument(help="The note's text; may be left out with a photograph.")] = "",
    photo: Annotated[Path | None, typer.Option("--photo", help="A photograph, JPEG or PNG.", dir_okay=False)] = None,
    run: RunOption = "latest",
    step: Annotated[str, typer.Option("--step", help="The step, if it is not the current one.")] = "",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Write a note on a step of a run, with or without a photograph; the run goes on as it was."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, _ = recorded_run(store, run_id)
        photograph = None if photo is None else _photograph(photo)
        name = acting_person(store, operator, "operate", password_stdin=password_stdin).name
        log = read_log(store, run_id, protocol)
        event = take_note(log, text, photograph, step=step, actor=name, via="cli")
        _report_recorded(run_id, "note", step or log.state.current, name, json=json, seq=event.seq)


def _photograph(path: Path) -> NotePhotograph:
    try:
        require_size(path.stat().st_size, path.name)
        return NotePhotograph(path.read_bytes(), path.name)
    except OSError as error:
        raise ConfigurationError(
            f"the photograph cannot be read: {error.strerror}", where=str(path), remedy="Check --photo"
        ) from error


def draw_region_command(
    corners: Annotated[
        str,
        typer.Argument(
            help="At least three corners as a JSON list of lists: x, y, z in metres, in the frame of the scan."
        ),
    ],
    source: Annotated[Literal["ct", "scan"], typer.Option("--source", help="What counts within the polygon.")],
    along: Annotated[
        str, typer.Option("--along", help="The direction from the surface to the viewer, as a JSON list of x, y, z.")
    ],
    run: RunOption = "latest",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Draw a region in which the CT or the scan counts; the next fusion uses it, as one drawn on the 3D view."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, _ = recorded_run(store, run_id)
        name = acting_person(store, operator, "operate", password_stdin=password_stdin).name
        region = read_region(step_to_draw_for(read_log(store, run_id, protocol)), source, corners, along)
        (event,) = store.record(run_id, [region], actor=name)
        _report_recorded(run_id, "region", region.step, name, json=json, seq=event.seq)


def cancel_command(
    job: Annotated[str, typer.Argument(help="The computation, as `status` names it, or its first characters.")],
    reason: Annotated[str, typer.Option("--reason", help="Why; it goes into the record.")],
    run: RunOption = "latest",
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """End one computation of a run. The step that waits for it asks what to do, as if it had failed."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        chosen = _open_job(store, run_id, job)
        name = acting_person(store, operator, "operate", password_stdin=password_stdin).name
        event = cancel_computation(store, run_id, chosen.job_id, reason, actor=name)
        if json:
            print_json({"run": run_id, "cancelled": chosen.job_id, "event": event.seq})
        else:
            console.print(f"Cancelled: {term(chosen.kind)} of step {chosen.step} by {name}")


def _open_job(store: Store, run_id: str, name: str) -> Job:
    """Return the job that a name or its first characters mean. Raises ConfigurationError."""
    found = [job for job in store.jobs(run_id) if job.state in ("queued", "running") and job.job_id.startswith(name)]
    if len(found) != 1:
        what = f"{len(found)} computations of the run begin with" if found else "no computation of the run is called"
        raise ConfigurationError(
            f"{what} {name!r}", where=run_id, remedy="`orthocapture status` lists those that wait or run"
        )
    return found[0]
