"""What each event does to the state of a run; `fold` applies them."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from service.core.errors import IllegalTransitionError, IntegrityError, what_of
from service.core.gates import evaluate_gates, refuse_release
from service.core.protocol import Protocol
from service.core.records.base import seconds_between
from service.core.records.events import Event
from service.core.records.run_events import (
    ActionRefused,
    CaptureAsked,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
    FilesKept,
    GatesEvaluated,
    ItemTicked,
    JobEnqueued,
    JobFailed,
    JobFinished,
    LeaveLapsed,
    RecordedView,
    RegionDrawn,
    RobotSeen,
    RunAborted,
    RunCompleted,
    RunReleased,
    RunStarted,
    SessionStarted,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
    ViewImported,
    ViewpointFailed,
)
from service.core.run.actions import needs_leave, unmet_requirements
from service.core.run.state import (
    ENDINGS,
    NO_ARM,
    NOT_WAITING,
    UNMEASURED,
    ArmConnection,
    DrawnRegion,
    FailedTries,
    Failure,
    JobState,
    Lapse,
    Loss,
    Note,
    RunState,
    Trouble,
    change,
    deviate,
    go,
    pass_on,
    supersede,
    wait,
)

Value = TypeVar("Value")


@dataclass(slots=True)
class _Versions(Generic[Value]):
    """The part that all versions of a mapping share: the values of each key, with the version that added each."""

    values: dict[str, list[tuple[int, Value]]] = field(default_factory=dict[str, list[tuple[int, Value]]])
    newest: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


class PersistentMap(Mapping[str, Value]):
    """An immutable dict; `put` returns the next version in constant time.

    Copying a dict for every event would make the fold of a run quadratic in its length. Instead, versions share their
    items, and each version sees those that existed when it was made. `put` copies only if called on an old version.
    """

    __slots__ = ("_length", "_shared", "_version")

    def __init__(self, items: Mapping[str, Value] | None = None) -> None:
        shared = _Versions[Value]()
        for key, value in (items or {}).items():
            shared.values[key] = [(0, value)]
        self._shared, self._version, self._length = shared, 0, len(shared.values)

    def put(self, key: str, value: Value) -> PersistentMap[Value]:
        """Return a new version with `value` under `key`; a new key comes last, an existing one keeps its place."""
        shared = self._shared
        with shared.lock:
            if shared.newest == self._version:
                shared.newest += 1
                shared.values.setdefault(key, []).append((shared.newest, value))
                return self._next(shared, self._length + (key not in self))
        return PersistentMap({**self, key: value})

    @classmethod
    def _next(cls, shared: _Versions[Value], length: int) -> PersistentMap[Value]:
        following = cls.__new__(cls)
        following._shared, following._version, following._length = shared, shared.newest, length
        return following

    def __getitem__(self, key: str) -> Value:
        """Return the value of `key` in this version. Raises KeyError."""
        for version, value in reversed(self._shared.values[key]):
            if version <= self._version:
                return value
        raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        """Return the keys of this version in order of insertion."""
        return iter([key for key in list(self._shared.values) if key in self])

    def __len__(self) -> int:
        """Return the number of keys in this version."""
        return self._length

    def __repr__(self) -> str:
        """Return `PersistentMap({…})` with the items of this version."""
        return f"PersistentMap({dict(self)!r})"

    def __reduce__(self) -> tuple[type[PersistentMap[Value]], tuple[dict[str, Value]]]:
        """Pickle as an independent mapping with the items of this version."""
        return PersistentMap, (dict(self),)


def put(items: Mapping[str, Value], key: str, value: Value) -> PersistentMap[Value]:
    """Return `items` with `value` under `key`; in constant time for the newest version of a PersistentMap."""
    return (items if isinstance(items, PersistentMap) else PersistentMap(items)).put(key, value)


def impossible(event: Event, why: str) -> IntegrityError:
    """Return the error for an event that cannot have happened in its place."""
    return IntegrityError(
        f"{event.payload.kind} cannot have happened here: {why}",
        where=f"run {event.run_id} event {event.seq}",
        remedy="Run `orthocapture audit verify` on this run; do not continue it",
    )


def triggered(protocol: Protocol, state: RunState, event: Event, trigger: str, **changes: Any) -> RunState:
    """Return the state after a trigger of the lifecycle. Raises IntegrityError if it is not allowed now."""
    try:
        return go(protocol, state, trigger, **changes)
    except IllegalTransitionError as error:
        raise impossible(event, str(error)) from error


def without_effect(state: RunState, event: Event) -> RunState:
    """Note that an event has no effect on the state; it stays in the evidence."""
    return replace(state, overtaken=(*state.overtaken, event.seq))


def is_void(state: RunState, event: Event, step: str, attempt: int, *, when_completed: bool = False) -> bool:
    """Return whether an operator's redo, skip or abort was recorded before the outcome of the work.

    The web and the command line append actions while the runner works, so such events are legitimate; they stay in
    the evidence without effect. With `when_completed`, the work may still be recorded after the run was completed.
    Raises IntegrityError for work that was never due.
    """
    if step not in state.steps:
        raise impossible(event, f"the protocol has no step {step!r}")
    there = state.steps[step]
    ended = state.status == "aborted" if when_completed else state.terminal
    if attempt < there.attempt or ended or (there.skipped and attempt == there.attempt):
        return True
    if attempt > there.attempt:
        raise impossible(event, f"attempt {attempt} of {step} has not begun; it is at {there.attempt}")
    return False


def is_void_now(state: RunState, event: Event, step: str, attempt: int) -> bool:
    """Return `is_void` for events that only the current step can produce. Raises IntegrityError for another step."""
    if is_void(state, event, step, attempt):
        return True
    if step != state.current:
        raise impossible(event, f"the run is at {state.current}")
    return False


def require_running(state: RunState, event: Event) -> None:
    """Raise IntegrityError unless the current step is running."""
    if state.phase != "running":
        raise impossible(event, f"{state.current} is {state.phase}, not running")


def device_opened(protocol: Protocol, state: RunState, event: Event, p: DeviceOpened) -> RunState:
    """An arm is connected; that does not say that anybody has looked at it since its last connection was lost."""
    identity = p.report.get("identity")
    if not isinstance(identity, dict) or identity.get("kind") != "robot":
        return state
    arm = state.arms.get(p.device, NO_ARM)
    return with_arm(state, p.device, replace(arm, connected=True, refused_utc="", refused_why=""))


def device_trouble(protocol: Protocol, state: RunState, event: Event, p: DeviceTrouble) -> RunState:
    """List a device's trouble; an arm whose connection ended with it counts as moving."""
    state = replace(state, troubles=(*state.troubles, Trouble(event.seq, p.device, p.error, p.message)))
    if not p.connection:
        return state
    arm = state.arms.get(p.device, NO_ARM)
    if p.connection == "refused":
        refused = replace(arm, connected=False, refused_utc=event.at_utc, refused_why=what_of(p.message))
        return with_arm(state, p.device, refused)
    why = what_of(p.message)
    how = f"{ENDINGS[p.connection]} ({why.rpartition(': ')[2] if p.connection == 'died' else why})"
    return with_arm(state, p.device, lost(arm, event.seq, event.at_utc, how))


def lost(arm: ArmConnection, seq: int, at_utc: str, how: str) -> ArmConnection:
    """Return an arm whose connection was lost, since the first loss that nobody has looked at."""
    since_utc = at_utc if arm.loss is None else arm.loss.since_utc
    return replace(arm, connected=False, loss=Loss(seq, since_utc, how), lost_utc=at_utc, seen_by="", seen_utc="")


def connections_ended(state: RunState, event: Event) -> RunState:
    """The program that drove the run has ended, and with it its connections, at some time after the last event."""
    arms = {
        name: lost(arm, event.seq, state.at_utc, ENDINGS["program"]) if arm.connected else arm
        for name, arm in state.arms.items()
    }
    return replace(state, arms=arms) if arms != state.arms else state


def robot_seen(protocol: Protocol, state: RunState, event: Event, p: RobotSeen) -> RunState:
    """A person has looked at an arm; without effect if its connection was lost again since the page was shown."""
    arm = state.arms.get(p.device)
    answered = arm is not None and (p.lost_seq == 0 if arm.loss is None else p.lost_seq == arm.loss.seq)
    if arm is None or not answered:
        return without_effect(state, event)
    lost_utc = arm.lost_utc if arm.loss is not None else state.at_utc
    seen = replace(arm, loss=None, lost_utc=lost_utc, seen_by=event.actor, seen_utc=event.at_utc)
    # Without a recorded loss it was the program that had ended, and with it the connection.
    return with_arm(state, p.device, seen if p.lost_seq else replace(seen, connected=False))


def all_seen(state: RunState, event: Event) -> RunState:
    """Whoever lets the robot move has looked at it: the question asks for that."""
    arms = {
        name: replace(arm, loss=None, seen_by=event.actor, seen_utc=event.at_utc) if arm.loss is not None else arm
        for name, arm in state.arms.items()
    }
    return replace(state, arms=arms) if arms != state.arms else state


def leave_lapsed(protocol: Protocol, state: RunState, event: Event, p: LeaveLapsed) -> RunState:
    """The leave to move is over; without effect if a person has given another one meanwhile."""
    if state.leave is None or state.leave.seq != p.leave_seq:
        return without_effect(state, event)
    lapse = Lapse(event.seq, state.leave.by, p.idle_s, p.limit_s, p.why)
    return wait(protocol, replace(state, leave=None, lapse=lapse), event)


def with_arm(state: RunState, name: str, arm: ArmConnection) -> RunState:
    """Return the state with another record of one arm."""
    return replace(state, arms={**state.arms, name: arm})


def run_started(protocol: Protocol, state: RunState, event: Event, p: RunStarted) -> RunState:
    """The run begins, with its operator."""
    if (p.protocol_id, p.protocol_version) != (protocol.id, protocol.version):
        raise impossible(event, f"the run is of protocol {p.protocol_id} {p.protocol_version}, not of the given one")
    return replace(
        state,
        run_id=event.run_id,
        operator=p.operator,
        simulated=p.simulated,
        origin=p.origin,
        auto_confirm=p.auto_confirm,
        people=frozenset({p.operator}),
    )


def session_started(protocol: Protocol, state: RunState, event: Event, p: SessionStarted) -> RunState:
    """The runner began or resumed; a resumed run needs a new leave to move, and its arms count as moving."""
    state = connections_ended(state, event) if p.resumed else state
    state = replace(state, sessions=state.sessions + 1, restarted=p.resumed, leave=None if p.resumed else state.leave)
    # Whoever lets the robot move again must check again: the ticks were made before the program ended.
    return change(state, state.current, ticked=()) if needs_leave(protocol, state) else state


def files_kept(protocol: Protocol, state: RunState, event: Event, p: FilesKept) -> RunState:
    """Files were stored for a step: no effect on the state."""
    return without_effect(state, event) if is_void(state, event, p.step, p.attempt) else state


def run_completed(protocol: Protocol, state: RunState, event: Event, p: RunCompleted) -> RunState:
    """The last step has passed, and the run ends."""
    done = state.current == protocol.step_ids[-1] and state.phase == "passed"
    if state.terminal or not done:
        redone_just_before = state.last_redo_seq == state.seq
        if state.status == "aborted" or redone_just_before:
            return without_effect(state, event)
        raise impossible(event, f"the run is {state.status} at {state.current}, {state.phase}")
    completed = triggered(protocol, state, event, "advance")
    return replace(completed, completed_sha256=event.sha256, ended_utc=event.at_utc)


def run_aborted(protocol: Protocol, state: RunState, event: Event, p: RunAborted) -> RunState:
    """The run ends early."""
    if state.status == "aborted":  # the runner's own record of an operator's abort
        return replace(state, stop_reason=state.stop_reason or p.reason)
    return replace(triggered(protocol, state, event, "abort"), stop_reason=p.reason)


def worked_s(state: RunState, event: Event) -> float | None:
    """Return the seconds that the work of the current step has taken; None if it did not begin."""
    return state.step.work_s(event.at_utc) if state.step.work_began_utc else None


def step_started(protocol: Protocol, state: RunState, event: Event, p: StepStarted) -> RunState:
    """The step's work begins, if a person has confirmed it and what it requires has passed."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    step, now = protocol.step(p.step), state.step
    if step.confirm and not now.confirmed:
        raise impossible(event, "the operator has not confirmed")
    if unmet_requirements(step, state) or (step.irreversible and not now.signed):
        raise impossible(event, "what it requires has not passed, or nobody has signed")
    state = replace(state, last_view=("", ""))
    began = {"started_utc": event.at_utc, "work_began_utc": event.at_utc, **NOT_WAITING}
    return triggered(protocol, state, event, "begin", failures=0, **began)


def step_note(protocol: Protocol, state: RunState, event: Event, p: StepNote) -> RunState:
    """Keep what a step noted."""
    if is_void(state, event, p.step, p.attempt):
        return without_effect(state, event)
    note = Note(event.seq, event.at_utc, p.note, p.data, p.attempt)
    return change(state, p.step, notes=(*state.steps[p.step].notes, note))


def step_measured(protocol: Protocol, state: RunState, event: Event, p: StepMeasured) -> RunState:
    """Keep the measures and the result of a step; its gates are judged next."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    return triggered(
        protocol,
        state,
        event,
        "measured",
        measures=p.measures,
        artefacts=p.artefacts,
        result=p.result,
        uncertainties=p.uncertainties,
        computed_by=p.computed_by,
        failures=0,
        tries=None,
        worked_s=worked_s(state, event),
    )


def step_failed(protocol: Protocol, state: RunState, event: Event, p: StepFailed) -> RunState:
    """Keep why a step failed."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    failure = Failure(event.seq, p.error, p.message, p.recovery, event.at_utc)
    failures = state.step.failures + 1
    tries = state.step.tries
    if tries is None or tries.message != p.message:  # else it is the failure of a viewpoint, reported before
        tries = FailedTries("", failures, p.message, event.at_utc)
    changes = {"failure": failure, "failures": failures, "tries": tries, "worked_s": worked_s(state, event)}
    return triggered(protocol, state, event, "failed", **changes)


def step_retried(protocol: Protocol, state: RunState, event: Event, p: StepRetried) -> RunState:
    """The next attempt of a step begins."""
    if is_void_now(state, event, p.step, p.attempt - 1):  # a retry names the attempt that it begins
        return without_effect(state, event)
    now = state.step
    if not (now.retry_granted or (now.failure is not None and now.failure.recovery == "retry")):
        raise impossible(event, "neither the policy nor the operator allowed a retry")
    state = replace(state, last_view=("", ""))
    changes: dict[str, Any] = {**UNMEASURED, "attempt": p.attempt, "retry_granted": False}
    changes |= {"work_began_utc": event.at_utc, **NOT_WAITING}
    if protocol.step(p.step).irreversible:  # its signature let it begin and remains valid
        changes |= {"signed": now.signed, "signed_by": now.signed_by}
    if now.retry_granted:  # viewpoints that were given up are tried again
        changes |= {"failures": 0, "viewpoint_failures": {}, "skipped_viewpoints": ()}
    return triggered(protocol, state, event, "retry", **changes)


def gates_evaluated(protocol: Protocol, state: RunState, event: Event, p: GatesEvaluated) -> RunState:
    """Keep the verdicts, which must follow from the measures and the limits."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    now = state.step
    if p != evaluate_gates(protocol.step(p.step), p.attempt, now.measures, state.skipped, now.uncertainties):
        raise impossible(event, "the verdicts do not follow from the measures and the protocol's limits")
    trigger = "gates_passed" if p.passed else "gates_failed"
    changes = {"verdicts": p.verdicts, "gates_passed": p.passed, "gates_sha256": event.sha256}
    return triggered(protocol, state, event, trigger, **changes)


def step_passed(protocol: Protocol, state: RunState, event: Event, p: StepPassed) -> RunState:
    """The run goes on to the next step."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    if protocol.step(p.step).sign and not state.step.signed:
        raise impossible(event, "nobody has signed")
    changes = {"passed_sha256": event.sha256, "passed_seq": event.seq, "ended_utc": event.at_utc}
    return pass_on(protocol, triggered(protocol, state, event, "accept", **changes))


_VIEWS_TIMED = 30  # number of latest views whose median gap estimates the time per view


def _with_view(state: RunState, event: Event, step: str) -> RunState:
    """Record the time since the step's previous view, for the latest views only."""
    there, at_utc = state.last_view
    gaps = state.view_gaps_s
    if there == step:
        gaps = (*gaps, seconds_between(at_utc, event.at_utc))[-_VIEWS_TIMED:]
    return replace(state, view_gaps_s=gaps, last_view=(step, event.at_utc))


def capture_asked(protocol: Protocol, state: RunState, event: Event, p: CaptureAsked) -> RunState:
    """Note what was asked of a manual capture; a request that comes too late has no effect."""
    if state.terminal or (p.step, p.attempt, "running") != (state.current, state.step.attempt, state.phase):
        return without_effect(state, event)
    return change(state, p.step, asked=(*state.step.asked, p.what))


def view_added(protocol: Protocol, state: RunState, event: Event, p: RecordedView) -> RunState:
    """Count an image; of two with the same name within an attempt, the later one."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(_among_the_superseded(state, event, p), event)
    require_running(state, event)
    state = _with_view(state, event, p.step)
    now = state.step
    if p.viewpoint in now.captured:  # taken again within the attempt: the later one counts
        earlier = {p.viewpoint: now.captured[p.viewpoint]}
        again = "imported again" if isinstance(p, ViewImported) else "captured again"
        state = supersede(state, event, p.step, again, p.viewpoint, earlier)
    return change(
        state,
        p.step,
        captured=put(now.captured, p.viewpoint, event.seq),
        skipped_viewpoints=tuple(name for name in now.skipped_viewpoints if name != p.viewpoint),
        failures=0,
        tries=None,
    )


def _among_the_superseded(state: RunState, event: Event, p: RecordedView) -> RunState:
    """Add an image that arrived after its attempt was replaced to the superseded images of that attempt."""
    listed = [
        replace(past, captured=put(past.captured, p.viewpoint, event.seq))
        if (past.step, past.attempt, past.viewpoint) == (p.step, p.attempt, None)
        else past
        for past in state.superseded
    ]
    return replace(state, superseded=tuple(listed))


def viewpoint_failed(protocol: Protocol, state: RunState, event: Event, p: ViewpointFailed) -> RunState:
    """Count a failure of a viewpoint, which may be given up."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    require_running(state, event)
    now = state.step
    counts = put(now.viewpoint_failures, p.viewpoint, now.viewpoint_failures.get(p.viewpoint, 0) + 1)
    given_up, tries = now.skipped_viewpoints, now.tries
    if p.skipped and p.viewpoint not in given_up:
        given_up = (*given_up, p.viewpoint)
        state = deviate(state, event, "viewpoint_skipped", p.step, f"{p.viewpoint} given up: {p.message}")
    if not p.skipped:
        tries = FailedTries(p.viewpoint, counts[p.viewpoint], p.message, event.at_utc)
    return change(state, p.step, viewpoint_failures=counts, skipped_viewpoints=given_up, tries=tries)


def job_enqueued(protocol: Protocol, state: RunState, event: Event, p: JobEnqueued) -> RunState:
    """List a job of a step."""
    # A result that arrives after the run's end may still lead to further jobs.
    if is_void(state, event, p.step, p.attempt, when_completed=True):
        return without_effect(state, event)
    jobs = state.steps[p.step].jobs
    if p.job in jobs:
        raise impossible(event, f"job {p.job} is enqueued already")
    job = JobState(
        p.job,
        p.job_kind,
        p.attempt,
        event.seq,
        p.idempotency_key,
        p.arguments,
        priority=p.priority,
        enqueued_utc=event.at_utc,
    )
    return change(state, p.step, jobs=put(jobs, p.job, job))


def job_ended(protocol: Protocol, state: RunState, event: Event, p: JobFinished | JobFailed) -> RunState:
    """Keep a job's answer, or why it failed."""
    job = state.steps[p.step].jobs.get(p.job) if p.step in state.steps else None
    if job is None:
        if is_void(state, event, p.step, p.attempt):
            return without_effect(state, event)
        raise impossible(event, f"job {p.job} was never enqueued")
    if job.status == "finished":  # a second worker answered after a lost lease: the first answer counts
        return without_effect(state, event)
    if isinstance(p, JobFinished):
        done = {"measures": p.measures, "artefacts": p.artefacts, "result": p.result}
        job = replace(job, status="finished", duration_s=p.duration_s, late_s=p.late_s, **done)
    else:
        job = replace(job, status="failed", error=p.error, message=p.message)
    job = replace(job, ended_seq=event.seq, ended_utc=event.at_utc)
    return change(state, p.step, jobs=put(state.steps[p.step].jobs, p.job, job))


def action_refused(protocol: Protocol, state: RunState, event: Event, p: ActionRefused) -> RunState:
    """List a refused action as a deviation."""
    return deviate(state, event, "refused", p.step, f"{p.action} refused: {p.why}")


def item_ticked(protocol: Protocol, state: RunState, event: Event, p: ItemTicked) -> RunState:
    """Tick or untick an item; no effect if it comes too late or the protocol has no such item."""
    asked = state.phase in ("ready", "recovering") or needs_leave(protocol, state)
    open_now = asked and (p.step, p.attempt) == (state.current, state.step.attempt)
    if state.terminal or not open_now:
        return without_effect(state, event)
    items = [item for item in protocol.step(p.step).checklist if item in state.step.ticked and item != p.item]
    if p.ticked and p.item in protocol.step(p.step).checklist:
        items.append(p.item)
    return change(state, p.step, ticked=tuple(items))


def control_taken(protocol: Protocol, state: RunState, event: Event, p: ControlTaken) -> RunState:
    """Another screen controls the run, or none."""
    controller = event.actor if p.screen else ""
    return replace(state, controller=controller, people=state.people | {event.actor})


def run_released(protocol: Protocol, state: RunState, event: Event, p: RunReleased) -> RunState:
    """A person releases the run, if that is allowed."""
    refusal = refuse_release(state, event.actor, p.signed_sha256)
    if refusal is not None:
        return deviate(state, event, "refused", None, f"release had no effect: {refusal}")
    return replace(state, released_by=event.actor)


def region_drawn(protocol: Protocol, state: RunState, event: Event, p: RegionDrawn) -> RunState:
    """Keep it for the next fusion; a region drawn after the end of the run has no effect."""
    if state.terminal:
        return without_effect(state, event)
    return replace(state, drawn=(*state.drawn, DrawnRegion(event.seq, event.actor, p)))
