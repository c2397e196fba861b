"""The state of a run that its events add up to, as frozen records: RunState, its parts, their elementary changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from service.core.protocol import Protocol
from service.core.records.base import ArtefactRef, seconds_between
from service.core.records.events import Event
from service.core.records.run_events import ComputedBy, GateVerdict, Identified, RegionDrawn, Uncertainty
from service.core.run.lifecycle import ABORTED, COMPLETED, Phase, lifecycle
from service.core.words import counted

MOTION_PLAN = "motion_plan"  # name of the note


class _NoteRecord(BaseModel):
    model_config = ConfigDict(frozen=True)


class HandWork(_NoteRecord):
    """The work that a technician should do by hand, for a simulated one; further fields are those of the action."""

    model_config = ConfigDict(frozen=True, extra="allow")

    action: str  # its name in simulators/rig/world_server.py


class Mending(_NoteRecord):
    """A way to bring an attempt of a step within its limits.

    Attributes:
        advice: the advice to the technician.
        title: the request in few words, where it is the normal course of the step and nothing went wrong.
        does: the effect of the next confirmation in that case, as a button's label; "" where something went wrong.
        hands: the same for a simulated technician.
        viewpoints: further views that a retry takes; only their number counts.
        poses: further poses above the calibration board; only their number counts.
        images: number of images that a retry takes again.
    """

    advice: str = ""
    title: str = ""
    does: str = ""
    hands: tuple[HandWork, ...] = ()
    viewpoints: tuple[object, ...] = ()
    poses: tuple[object, ...] = ()
    images: int = 0


class NotedView(_NoteRecord):
    """A viewpoint in a motion plan.

    Attributes:
        viewpoint: its name.
        outcome: the planner's answer: feasible, nudged, or refused where the arm cannot take it.
        reason: the reason of a refusal.
        nudge_deg: the angle by which it was turned along its arc so that the arm can take it.
        joints_rad: the arm's joints there; None if refused.
        travel_s: the travel time from the view before.
        way_rad: joints of a detour, from those of the view before to the last before this view's; empty if straight.
    """

    viewpoint: str
    outcome: str
    reason: str = ""
    nudge_deg: float = 0.0
    joints_rad: tuple[float, ...] | None = None
    travel_s: float = 0.0
    way_rad: tuple[tuple[float, ...], ...] = ()


class NotedStation(_NoteRecord):
    """The viewpoints of one station in the order of capture, and how long all of them take."""

    station: str = ""
    order: str = ""
    estimated_s: float = 0.0
    views: tuple[NotedView, ...]


class NotedMotionPlan(_NoteRecord):
    """The arm's motion in a capture."""

    stations: tuple[NotedStation, ...] = ()

    @property
    def views(self) -> tuple[NotedView, ...]:
        """All viewpoints in the order of capture."""
        return tuple(view for station in self.stations for view in station.views)

    @property
    def view_s(self) -> float | None:
        """Estimated seconds for one view; None without a plan."""
        total_s = sum(station.estimated_s for station in self.stations)
        able = sum(view.outcome != "refused" for view in self.views)
        return total_s / able if total_s > 0 and able else None


LIVE = 0  # shown to a person while the arm moves
WAITED = 1  # a step waits for it
EARLY = 10  # prepared while the images arrive
LATER = 20  # arrives after the decision and holds nothing up
REDUCED = 30  # reduced resolutions, only for comparison in a table

Lane = Literal["waited", "background"]


def lane_of(priority: int) -> Lane:
    """Return `waited` if a step or a person waits for jobs of this priority, else `background`."""
    return "waited" if priority < EARLY else "background"


@dataclass(frozen=True, slots=True)
class Loss:
    """The end of a connection to an arm, after which nobody has looked at it yet."""

    seq: int  # the newest event that reports it: what a person answers
    since_utc: str  # the time of the first loss since somebody looked
    how: str  # a phrase that follows a time: `when its driver's process ended (died of SIGKILL)`


@dataclass(frozen=True, slots=True)
class ArmConnection:
    """The recorded state of the connection to one arm. An arm whose connection was lost counts as moving.

    Attributes:
        connected: true if it was opened, and no later event says that the connection has ended.
        loss: the loss of the connection, until a person has looked.
        lost_utc: the time when a connection to it was last lost; "" if none was.
        refused_utc: the time when it could not be connected; "" once it was.
        refused_why: the driver's reason then.
        seen_by: the person who has looked at it since it was lost.
        seen_utc: the time when they looked.
    """

    connected: bool = False
    loss: Loss | None = None
    lost_utc: str = ""
    refused_utc: str = ""
    refused_why: str = ""
    seen_by: str = ""
    seen_utc: str = ""


NO_ARM = ArmConnection()
ENDINGS: Mapping[str, str] = {
    "died": "when its driver's process ended",
    "stalled": "when its driver no longer answered",
    "broken": "when the arm no longer answered its driver",
    "program": "when the program that drives the run ended",
}


def lost_arms(state: RunState) -> dict[str, Loss]:
    """Return the arms that count as moving because a connection was lost and nobody has looked since, by name."""
    return {name: arm.loss for name, arm in state.arms.items() if arm.loss is not None}


def connected_arms(state: RunState) -> tuple[str, ...]:
    """Return the arms to which a connection is open, as far as the record knows."""
    return tuple(name for name, arm in state.arms.items() if arm.connected)


# The progress text of a step while a person takes the images: the camera is idle and shows its live view.
WAITING_FOR_HAND = "waiting for the next image"
StepPhase = Literal["pending", "ready", "running", "checking", "awaiting_operator", "recovering", "passed"]
Status = Literal["active", "paused", "completed", "aborted"]
DeviationKind = Literal[
    "skip",
    "gate_overridden",
    "gate_accepted",
    "redo",
    "redo_viewpoint",
    "reset_by_redo",
    "viewpoint_skipped",
    "refused",
    "automatic",
]


@dataclass(frozen=True, slots=True)
class JobState:
    """A job of the registration worker, as recorded in the events."""

    job: str
    kind: str
    attempt: int
    enqueued_seq: int
    idempotency_key: str
    arguments: Mapping[str, Any]
    status: Literal["enqueued", "finished", "failed"] = "enqueued"
    measures: Mapping[str, float] = field(default_factory=dict[str, float])
    artefacts: tuple[ArtefactRef, ...] = ()
    result: Mapping[str, Any] = field(default_factory=dict[str, Any])
    error: str = ""
    message: str = ""
    priority: int = WAITED
    enqueued_utc: str = ""
    ended_seq: int = 0  # its job_finished or job_failed event
    ended_utc: str = ""
    duration_s: float = 0.0
    late_s: float | None = None  # after the specimen was freed, or the run's end; None: in time


@dataclass(frozen=True, slots=True)
class Note:
    """A recorded StepNote with its sequence number and time."""

    seq: int
    at_utc: str
    note: str
    data: Mapping[str, Any]
    attempt: int = 0  # the step's attempt


@dataclass(frozen=True, slots=True)
class Failure:
    """The last StepFailed of a step that has not been recovered yet."""

    seq: int
    error: str
    message: str
    recovery: Literal["retry", "ask", "abort"]
    at_utc: str = ""


@dataclass(frozen=True, slots=True)
class FailedTries:
    """The last failure in a step that has not succeeded since, while nobody has decided anything."""

    what: str  # a viewpoint; "": the work of the step as a whole
    times: int
    message: str
    at_utc: str  # the time of the last failure


@dataclass(frozen=True, slots=True)
class AcceptedDeviation:
    """A person's acceptance of a step's figures outside their limits."""

    seq: int  # the operator_action event
    by: str
    role: str
    identified: Identified
    reason: str
    verdicts: tuple[GateVerdict, ...]  # the failed ones


@dataclass(frozen=True, slots=True)
class StepState:
    """The state of a step. `attempt` counts from 1 and is the present or the next attempt."""

    step: str
    attempt: int = 1
    phase: StepPhase = "pending"
    confirmed: bool = False
    confirmed_by: str = ""  # the person who let the present work begin, by confirming the step or its retry
    ticked: tuple[str, ...] = ()  # checklist items of the confirmation
    signed: bool = False
    signed_by: str = ""
    skipped: bool = False
    retry_granted: bool = False  # an operator confirmed in recovering
    measures: Mapping[str, float] = field(default_factory=dict[str, float])  # this attempt's measures
    artefacts: tuple[ArtefactRef, ...] = ()  # the artefacts of this attempt's step_measured
    result: Mapping[str, Any] = field(default_factory=dict[str, Any])
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict[str, Uncertainty])
    computed_by: tuple[ComputedBy, ...] | None = None  # jobs of the measures and the result; None: not recorded
    verdicts: tuple[GateVerdict, ...] = ()
    gates_passed: bool = False
    gates_sha256: str = ""  # the hash of the gates_evaluated event: what a signature of this step binds
    accepted: AcceptedDeviation | None = None  # set if a person accepted figures outside the limits
    passed_sha256: str = ""  # the hash of the step_passed event: what the signature of an irreversible step binds
    passed_seq: int = 0
    failure: Failure | None = None
    tries: FailedTries | None = None
    failures: int = 0  # consecutive failures without a captured viewpoint or a confirmation in between
    # Viewpoints, notes and jobs stay after a retry and cleared by a redo.
    captured: Mapping[str, int] = field(default_factory=dict[str, int])  # viewpoint → seq of its event
    viewpoint_failures: Mapping[str, int] = field(default_factory=dict[str, int])  # viewpoint → times
    skipped_viewpoints: tuple[str, ...] = ()  # given up
    notes: tuple[Note, ...] = ()
    asked: tuple[Literal["release", "finish"], ...] = ()  # requests of a person at a screen during a manual capture
    jobs: Mapping[str, JobState] = field(default_factory=dict[str, JobState])
    started_utc: str = ""
    ended_utc: str = ""
    work_began_utc: str = ""  # the start of the present attempt's work
    waits_since_utc: str = ""  # the arm's work waits for a person: it was paused, or the leave to move is over
    waited_s: float = 0.0  # the time that it waited so until then, since the work began
    worked_s: float | None = None  # the time that the last attempt worked until it had its figures or failed

    def work_s(self, now_utc: str) -> float:
        """Return the seconds that this attempt has worked until a time (ISO 8601), waiting excluded."""
        waits_s = seconds_between(self.waits_since_utc, now_utc) if self.waits_since_utc else 0.0
        return max(0.0, seconds_between(self.work_began_utc, now_utc) - self.waited_s - waits_s)

    @property
    def passed_its_gates(self) -> bool:
        """True if the step passed with its figures within limits or accepted; a skipped step did not."""
        return self.phase == "passed" and (self.gates_passed or self.accepted is not None) and not self.skipped

    @property
    def mend(self) -> Mending | None:
        """The way to bring this attempt within limits, by its newest note with `advice`; None without one.

        Advice in earlier notes is out of date and is ignored, `hands` included.
        """
        advised = (
            note.data for note in reversed(self.notes) if note.attempt == self.attempt and "advice" in note.data
        )
        newest = next(advised, None)
        return None if newest is None else Mending.model_validate(dict(newest))

    @property
    def in_course(self) -> Mending | None:
        """The step's request in its normal course before it can be judged; None where something went wrong."""
        mend = self.mend if self.phase == "recovering" and self.failure is None else None
        return mend if mend is not None and mend.does else None

    @property
    def motion_plan(self) -> NotedMotionPlan:
        """How the arm moves, by the newest plan; empty without one."""
        planned = (note.data for note in reversed(self.notes) if note.note == MOTION_PLAN)
        newest = next(planned, None)
        return NotedMotionPlan() if newest is None else NotedMotionPlan.model_validate(dict(newest))


@dataclass(frozen=True, slots=True)
class Superseded:
    """An attempt, or one viewpoint of it, that a later one replaced. Its evidence stays."""

    seq: int  # the event that superseded it
    step: str
    attempt: int
    reason: str
    viewpoint: str | None = None
    captured: Mapping[str, int] = field(default_factory=dict[str, int])
    began: bool = True  # true if its work had started


@dataclass(frozen=True, slots=True)
class Deviation:
    """A departure from the protocol; in `RunState.automatic`, a confirmation that was given automatically."""

    seq: int
    kind: DeviationKind
    step: str | None
    text: str
    actor: str = ""


@dataclass(frozen=True, slots=True)
class Trouble:
    """A recorded DeviceTrouble with its sequence number."""

    seq: int
    device: str
    error: str
    message: str


@dataclass(frozen=True, slots=True)
class Leave:
    """The person who gave leave for the robot to move, and the event in which they did."""

    seq: int
    by: str


@dataclass(frozen=True, slots=True)
class Lapse:
    """A leave to move that is over because nothing visible came of it for too long, until somebody gives another."""

    seq: int  # the event
    by: str  # the person who had given it
    idle_s: float
    limit_s: float
    why: str  # the thing that the run had waited for; "" if it is not known


@dataclass(frozen=True, slots=True)
class DrawnRegion:
    """A region of the ground truth that a person drew."""

    seq: int
    by: str
    region: RegionDrawn


@dataclass(frozen=True, slots=True)
class RunState:
    """The fold of a run's events."""

    machine_state: str  # its state in service.core.run.lifecycle
    current: str  # identifier of the step that the run is at, or was at when it ended
    steps: Mapping[str, StepState]
    status: Status = "active"
    seq: int = 0  # the last event; 0: nothing recorded yet
    at_utc: str = ""  # the time of the last event
    run_id: str = ""
    operator: str = ""
    simulated: bool = False
    origin: Literal["captured", "imported"] = "captured"
    auto_confirm: bool = False
    sessions: int = 0
    restarted: bool = False  # a new process drives the run, and nobody has confirmed or resumed since
    leave: Leave | None = None  # the newest one in this session; each arm takes it once
    lapse: Lapse | None = None  # the lapse of the leave, if nobody has given another since
    arms: Mapping[str, ArmConnection] = field(default_factory=dict[str, ArmConnection])  # arms by name in rig.yaml
    stop_reason: str = ""
    # The one list of what departed from the protocol: whoever counts or lists deviations takes it whole. A gate that
    # failed, a device that failed and a corrected value are none by themselves: what a person did about it is.
    deviations: tuple[Deviation, ...] = ()
    automatic: tuple[Deviation, ...] = ()  # confirmations that a simulated rig gave by itself
    superseded: tuple[Superseded, ...] = ()
    overtaken: tuple[int, ...] = ()  # seq of events that an operator's action had already made void
    troubles: tuple[Trouble, ...] = ()
    last_redo_seq: int = 0
    people: frozenset[str] = frozenset()  # those who took part: started it, controlled it, acted on it
    controller: str = ""  # person whose screen controls the run; "" for nobody
    drawn: tuple[DrawnRegion, ...] = ()  # regions of the ground truth that people drew, the latest last
    ended_utc: str = ""  # the time of run_completed or run_aborted
    completed_sha256: str = ""  # the hash of the run_completed event: what a release binds
    released_by: str = ""
    view_gaps_s: tuple[float, ...] = ()  # seconds between successive views of the same work, the latest ones
    last_view: tuple[str, str] = ("", "")  # step and time of the latest view of the present work

    @property
    def step(self) -> StepState:
        """The current step."""
        return self.steps[self.current]

    @property
    def phase(self) -> Phase:
        """Phase of the current step."""
        phase = self.step.phase
        assert phase != "pending"  # the current step is never pending
        return phase

    @property
    def started(self) -> bool:
        """True if run_started has been recorded."""
        return self.seq > 0

    @property
    def paused(self) -> bool:
        """True if an operator has paused the run."""
        return self.status == "paused"

    @property
    def skipped(self) -> frozenset[str]:
        """Steps that an operator skipped before they had figures; steps whose gates were overridden are not here."""
        return frozenset(name for name, step in self.steps.items() if step.skipped and not step.verdicts)

    @property
    def terminal(self) -> bool:
        """True if the run has ended, completed or aborted."""
        return self.status in ("completed", "aborted")

    @property
    def deviations_told(self) -> str:
        """The number of deviations as text, such as `1 deviation`."""
        return counted(len(self.deviations), "deviation")


# What a step forgets when its work is done again.
UNMEASURED: Mapping[str, Any] = {
    "measures": {},
    "artefacts": (),
    "result": {},
    "uncertainties": {},
    "verdicts": (),
    "gates_passed": False,
    "gates_sha256": "",
    "accepted": None,
    "signed": False,
    "signed_by": "",
    "failure": None,
}
# What a step knows of waits for a person when the work of an attempt begins.
NOT_WAITING: Mapping[str, Any] = {"waits_since_utc": "", "waited_s": 0.0}


def wait(protocol: Protocol, state: RunState, event: Event) -> RunState:
    """Let the arm's work wait from now on for a person; work without an arm goes on meanwhile."""
    if not protocol.step(state.current).moves_robot or state.step.waits_since_utc:
        return state
    return change(state, state.current, waits_since_utc=event.at_utc)


def wait_no_more(state: RunState, event: Event) -> RunState:
    """Record that a person has let the work go on."""
    since_utc, waited_s = state.step.waits_since_utc, state.step.waited_s
    if not since_utc:
        return state
    waited_s += seconds_between(since_utc, event.at_utc)
    state = change(state, state.current, waits_since_utc="", waited_s=waited_s)
    return replace(state, last_view=("", ""))  # the time until the next one is not that of a view


def go(protocol: Protocol, state: RunState, trigger: str, **changes: Any) -> RunState:
    """Fire a trigger and apply `changes` to the step that the run was at. Raises IllegalTransitionError."""
    machine = lifecycle(protocol.step_ids)
    target = machine.next(state.machine_state, trigger)
    steps = {**state.steps, state.current: replace(state.step, **changes)}
    place = machine.place(target)
    if place is None:
        status = COMPLETED if target == COMPLETED else ABORTED
        return replace(state, machine_state=target, status=status, steps=steps)
    steps[place.step] = replace(steps[place.step], phase=place.phase)
    status = "paused" if place.paused else "active"
    return replace(state, machine_state=target, status=status, current=place.step, steps=steps)


def change(state: RunState, step: str, **changes: Any) -> RunState:
    """Replace fields of one step."""
    return replace(state, steps={**state.steps, step: replace(state.steps[step], **changes)})


def pass_on(protocol: Protocol, state: RunState) -> RunState:
    """Advance from a passed step to the next one; after the last step the run waits for run_completed."""
    return state if state.current == protocol.step_ids[-1] else go(protocol, state, "advance")


def supersede(
    state: RunState, event: Event, step: str, reason: str, viewpoint: str | None, captured: Mapping[str, int]
) -> RunState:
    """List an attempt, or one viewpoint of it, as superseded by `event`."""
    now = state.steps[step]
    past = Superseded(event.seq, step, now.attempt, reason, viewpoint, captured, began=bool(now.started_utc))
    return replace(state, superseded=(*state.superseded, past))


def deviate(state: RunState, event: Event, kind: DeviationKind, step: str | None, text: str) -> RunState:
    """List a deviation that `event` caused, or an automatic confirmation, which is none."""
    one = Deviation(event.seq, kind, step, text, event.actor)
    if kind == "automatic":
        return replace(state, automatic=(*state.automatic, one))
    return replace(state, deviations=(*state.deviations, one))
