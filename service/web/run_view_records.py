"""The parts of the run page as plain records and figures; service.web.run_view fills them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import TYPE_CHECKING
from typing import Protocol as Interface

from service.computations.evaluate import Row
from service.core.disk_space import Forecast, size_words
from service.core.gates import AcceptedGate, figure
from service.core.measure_names import measure_name
from service.core.protocol import Gate, Protocol, Step
from service.core.recorded_devices import ClockReading
from service.core.records.events import Event
from service.core.records.run_events import GateVerdict, OperatorAction, OperatorVerb, RecordedView, SessionStarted
from service.core.run.expected import duration
from service.core.run.state import Deviation, RunState, StepState
from service.core.words import counted, time_here
from service.monitor.snapshot import Snapshot
from service.run_record import OpenJob
from service.steps.notes import images_taken
from service.web.run_frame import gate_word, limit

if TYPE_CHECKING:
    from service.store.objects.spool import SpoolLevel

_GIB = 2.0**30
_BAR_LIMIT = 75.0  # where along a bar its limit stands, in %


@dataclass(frozen=True, slots=True)
class GateLine:
    """A gate of a step, judged or not yet."""

    name: str
    value: str
    limit: str
    why: str
    status: str  # Within, Outside, Not decided, Accepted, Not yet, Not judged
    tone: str
    percent: float | None  # length of its bar; None where a bar would say nothing
    limit_percent: float


@dataclass(frozen=True, slots=True)
class CaptureProgress:
    """Images of the data set taken so far, and how long the rest takes."""

    done: int
    total: int
    percent: float
    left: str  # "about 12 min" or "measuring"
    step_done: int  # images taken in the current step
    step_total: int
    step_left: str


@dataclass(frozen=True, slots=True)
class Reading:
    """A figure of the rig or the machine."""

    name: str
    value: str
    tone: str = ""  # attention, stop
    note: str = ""


def gate_lines(step: Step, now: StepState, skipped: frozenset[str]) -> tuple[GateLine, ...]:
    """Return every gate of a step with what is known of it."""
    known = {verdict.measure: verdict for verdict in now.verdicts}
    accepted = now.accepted is not None
    return tuple(_gate_line(gate, known.get(gate.measure), skipped, accepted=accepted) for gate in step.gates)


def _gate_line(gate: Gate, verdict: GateVerdict | None, skipped: frozenset[str], *, accepted: bool) -> GateLine:
    limits = limit(gate.min, gate.max, gate.unit)
    name = measure_name(gate.measure)
    if verdict is None:
        if gate.unless_skipped is not None and gate.unless_skipped in skipped:
            why = f"{gate.unless_skipped} was skipped; without it there is no such number"
            return GateLine(name, "–", limits, why, "Not judged", "attention", None, _BAR_LIMIT)
        return GateLine(name, "–", limits, gate.why, "Not yet", "open", None, _BAR_LIMIT)
    percent = None
    bound = gate.max if gate.max is not None else gate.min
    if verdict.value is not None and bound is not None and bound > 0 and verdict.value >= 0:
        percent = min(100.0, _BAR_LIMIT * verdict.value / bound)
    status, tone = gate_word(verdict, accepted=accepted)
    return GateLine(name, figure(verdict), limits, gate.why, status, tone, percent, _BAR_LIMIT)


def capture_progress(protocol: Protocol, state: RunState, events: Sequence[Event]) -> CaptureProgress:
    """Count the progress from the record; estimate the time left from the times between this run's own exposures."""
    data_set = [s for s in protocol.steps if getattr(s.params, "purpose", "") == "dataset"]
    counts = [images_taken(step, state.steps[step.id]) for step in data_set]
    total, done = sum(count.known for count in counts), sum(count.taken for count in counts)
    here = images_taken(protocol.step(state.current), state.step)
    intervals = view_intervals_s(events, state.current)
    if len(intervals) < 2:
        intervals = view_intervals_s(events)
    later = protocol.steps[protocol.index(state.current) :]
    views_left = sum(
        images_taken(step, state.steps[step.id]).to_come for step in later if state.steps[step.id].phase != "passed"
    )
    each_s = median(intervals) if len(intervals) >= 2 else None
    return CaptureProgress(
        done=done,
        total=total,
        percent=100.0 * done / total if total else 0.0,
        left=_left(each_s, views_left),
        step_done=here.taken,
        step_total=here.known,
        step_left=_left(each_s, here.to_come),
    )


def view_intervals_s(events: Sequence[Event], step: str | None = None) -> list[float]:
    """Return seconds between exposures of the same attempt of a step, without a restart or a person's act between."""
    chains: list[list[tuple[str, int, float]]] = [[]]
    for event in events:
        if isinstance(event.payload, SessionStarted | OperatorAction):  # a pause is not the time of a view
            chains.append([])
        elif isinstance(event.payload, RecordedView) and step in (None, event.payload.step):
            chains[-1].append((event.payload.step, event.payload.attempt, event.monotonic_s))
    pairs = [pair for chain in chains for pair in pairwise(chain)]
    return [later[2] - earlier[2] for earlier, later in pairs if earlier[:2] == later[:2] and later[2] > earlier[2]]


def _left(each_s: float | None, views: int) -> str:
    if views <= 0:
        return "none"
    return "measuring" if each_s is None else duration(each_s * views)


def readings(
    snapshot: Snapshot,
    space: Forecast | None = None,
    clocks: Sequence[ClockReading] = (),
    spool: SpoolLevel | None = None,
) -> tuple[Reading, ...]:
    """Return what the runner last reported of machine and devices; what it did not report is shown as unknown.

    Args:
        snapshot: the runner's snapshot.
        space: forecast of what the run will still write, where it is known.
        clocks: the clocks as last compared; those beyond their limits are shown.
        spool: how full the spool is before an object store; None for a site without one.
    """
    battery = snapshot.camera_battery_fraction
    return (
        _space("Disk", snapshot.disk_free_bytes, low_gib=20, out_gib=5) if space is None else _disk(space),
        *([] if spool is None else [_spool(spool)]),
        _space("Camera card", snapshot.camera_free_bytes, low_gib=8, out_gib=2),
        Reading("Battery", "unknown")
        if battery is None
        else Reading(
            "Battery",
            f"{battery:.0%}",
            *(("stop", "change it now") if battery < 0.1 else ("attention", "low") if battery < 0.25 else ("", "")),
        ),
        Reading("Light", "unknown" if snapshot.light_lux is None else f"{snapshot.light_lux:.0f} lx"),
        Reading("Temperature", "unknown" if snapshot.temperature_c is None else f"{snapshot.temperature_c:.1f} °C"),
        *(
            Reading(f"Clock of {clock.name}", clock.difference, "attention", "set it")
            for clock in clocks
            if clock.within is False
        ),
    )


def _disk(space: Forecast) -> Reading:
    tone = {"enough": "", "short": "attention", "stop": "stop"}[space.verdict]
    to_come = f"{size_words(space.needed_bytes)} to come" if space.needed_bytes > 1e6 else ""
    note = {"enough": to_come, "short": f"will not do, {to_come}", "stop": "full: make room"}[space.verdict]
    return Reading("Disk", f"{size_words(space.free_bytes)} free", tone, note)


def _spool(level: SpoolLevel) -> Reading:
    waiting = level.waiting
    if not waiting.files:
        return Reading("Object store", "has all files")
    value = f"{counted(waiting.files, 'file')} to send, {size_words(waiting.size_bytes)}"
    since = f"since {time_here(waiting.since_utc)}"
    lasts = f", disk lasts {level.lasts_hours:.1f} h" if level.lasts_hours and level.lasts_hours < 1000 else ""
    if level.trouble is None:
        return Reading("Object store", value, "", f"{since}{lasts}")
    return Reading("Object store", value, "attention", f"{since}: {level.trouble.what}{lasts}")


def _space(name: str, free_bytes: int | None, *, low_gib: float, out_gib: float) -> Reading:
    if free_bytes is None:
        return Reading(name, "unknown")
    gib = free_bytes / _GIB
    tone, note = ("stop", "nearly full") if gib < out_gib else ("attention", "low") if gib < low_gib else ("", "")
    return Reading(name, f"{gib:.0f} GiB free" if gib >= 10 else f"{gib:.1f} GiB free", tone, note)


class RecordOfRun(Interface):
    """A run's record: service.run_record.RunRecord."""

    @property
    def protocol(self) -> Protocol:
        """The protocol as it was when the run began."""
        ...

    @property
    def events(self) -> Sequence[Event]:
        """All events, in order."""
        ...

    @property
    def state(self) -> RunState:
        """Their fold."""
        ...


@dataclass(frozen=True, slots=True)
class Viewer:
    """The person who looks, and how they stand to the control of this run."""

    may_operate: bool = False
    may_sign: bool = False  # true with or without control
    role: str = ""
    loses_release: bool = False  # this person could release the run, and acting on it ends that
    may_take_over: bool = False
    in_control: bool = False  # this screen
    holder: str = ""  # name of whoever has control; "" for nobody
    holder_screen: str = ""
    mine_elsewhere: bool = False  # the same person, on another screen
    asked_by: str = ""  # name of who asks for control
    asked_by_screen: str = ""
    asked_by_me: bool = False
    refused_by: str = ""  # name of who refused this screen's request
    refused_utc: str = ""
    taken_over_by: str = ""  # name of who took control from this person, if that was the last change of control
    taken_over_utc: str = ""
    taken_over_reason: str = ""


@dataclass(frozen=True, slots=True)
class StepLine:
    """A step in the list at the side."""

    id: str
    title: str
    word: str
    tone: str
    icon: str
    shown: bool
    reachable: bool  # something of it can be looked at


@dataclass(frozen=True, slots=True)
class ChecklistItem:
    """An item of the checklist."""

    text: str
    ticked: bool


@dataclass(frozen=True, slots=True)
class JudgedStep:
    """A step that passed while nobody decided anything."""

    step: str
    title: str
    seq: int  # number of the event by which it passed
    figures: tuple[str, ...]
    accepted: bool  # figures were accepted outside their limits


@dataclass(frozen=True, slots=True)
class StepView:
    """The step on the screen."""

    id: str
    title: str
    number: int
    attempt: int
    by_hand: bool  # a person takes its images
    only_ticks: bool  # it is nothing but its checklist
    why: str
    instructions: str
    drawing: str
    picture: str  # SHA-256 of the photograph on which the step shows what it found; "" without one
    station: str
    status: str
    current: bool
    checklist: tuple[ChecklistItem, ...]
    open_items: int
    gates: tuple[GateLine, ...]
    warning: str  # warning of an irreversible step that has not been done
    requires: tuple[tuple[str, bool], ...]
    captured: int
    unused: int  # number of these that are board images without use
    planned: int
    signed_by: str
    skipped: bool
    started_utc: str
    ended_utc: str
    table: Sequence[Row]  # rows of an evaluation
    usual: str  # how long it usually takes; "" if that is not known, or it is done
    depends: tuple[AcceptedGate, ...]  # figures accepted outside their limits that this step depends on


@dataclass(frozen=True, slots=True)
class MainAction:
    """The one large target."""

    verb: str  # an operator's verb, or go-on
    text: str
    note: str = ""
    hold: bool = False
    enabled: bool = True
    why_not: str = ""
    recommended: bool = True  # False where the table of ways recommends another one


@dataclass(frozen=True, slots=True)
class StepRedo:
    """A step that can be done again, and what that resets."""

    step: str
    title: str
    resets: tuple[str, ...]
    images: int  # number of images whose evidence stays, but which no longer count


@dataclass(frozen=True, slots=True)
class SignedContent:
    """The content that a signature binds."""

    sha256: str
    title: str
    figures: tuple[tuple[str, tuple[str, ...]], ...]  # figures by step
    meaning: str  # offered; the person may change it


@dataclass(frozen=True, slots=True)
class Acceptance:
    """The figures outside their limits that can be accepted now, and who may accept them."""

    sha256: str  # hash of the figures that the acceptance binds
    title: str
    figures: tuple[str, ...]
    role: str
    another: bool  # neither who began the run nor who confirmed the step
    affects: tuple[str, ...]  # later steps whose results depend on it, and will say so


@dataclass(frozen=True, slots=True)
class StepTrouble:
    """A step that needs a decision."""

    title: str
    short: str  # why it is stopped, and what is recommended
    what: str
    safe: str
    advice: str


@dataclass(frozen=True, slots=True)
class StepMore:
    """The request of a step in its normal course for more, before it can be judged."""

    title: str
    advice: str
    open: tuple[str, ...]  # figures that what there is does not decide


@dataclass(frozen=True, slots=True)
class Choice:
    """A choice of what to do now."""

    verb: OperatorVerb
    step: str
    words: str
    takes: str
    loses: str
    why_not: str  # "" if it can be taken
    button: str


@dataclass(frozen=True, slots=True)
class Question:
    """The question that the run asks of people now, and what they can do.

    Attributes:
        main: the one large button; None if there is nothing to press.
        options: further actions.
        can_pause: true if this person can pause the run.
        asked_anew: the program that drove the robot has ended, or the confirmation was too long ago, so nothing moves
            before somebody confirms again.
        lapsed: the reason why the confirmation no longer holds; "" where the program has ended.
        standing: the run is paused and the robot is known to stand still.
        paused: a text on how it stands with a paused run and its robot.
        more: the step's request in its normal course; None for nothing, or where something went wrong.
        trouble: the trouble for which the run is stopped; None if it is not.
        ways: the ways out of that, the recommended one first.
        signature: the content to be signed; None for nothing.
        acceptance: the figures that could be accepted outside their limits; None for nothing.
        redos: steps that can be done again.
        skip_overrides: true if a skip would now override figures outside their limits.
    """

    main: MainAction | None
    options: tuple[OperatorVerb, ...]
    can_pause: bool
    asked_anew: bool
    lapsed: str
    standing: bool
    more: StepMore | None
    paused: str
    trouble: StepTrouble | None
    ways: tuple[Choice, ...]
    signature: SignedContent | None
    acceptance: Acceptance | None
    redos: tuple[StepRedo, ...]
    skip_overrides: bool


@dataclass(frozen=True, slots=True)
class RunView:
    """The data that the run page shows."""

    run_id: str
    title: str
    seq: int
    status: str  # active, paused, completed, aborted
    mode: str  # ask, sign, more, recover, work, paused, died, ended
    headline: str  # news for screen readers when it changes
    tab: str  # title of the page
    current: str
    attempt: int
    steps: tuple[StepLine, ...]
    passed: int
    shown: StepView
    judged: tuple[JudgedStep, ...]  # steps judged since a person last decided something, the newest first
    question: Question
    viewer: Viewer
    progress: CaptureProgress
    readings: tuple[Reading, ...]
    working: tuple[str, int, int]
    takes: tuple[str, ...]  # how long the work usually takes, and until when nobody is needed
    work_left: str  # how long the rest of the run usually takes; "" if that is not known
    tries: str  # a text on what failed and is tried again by itself; "" for nothing
    deviations: tuple[Deviation, ...]
    news: tuple[tuple[str, str], ...]
    to_come: tuple[str, ...]  # results that are still being computed, with the time left
    computing: tuple[OpenJob, ...]  # jobs that wait or are computed, which a person may end
    pedal_armed: bool
    stop_reason: str
    operator: str
    released_by: str
