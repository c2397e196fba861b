"""Figures of the run page: gates against limits, images taken, time left from measured times, state of the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

from service.core.clocks import ClockReading
from service.core.disk_space import Forecast, size_words
from service.core.gates.measure_names import measure_name
from service.core.gates.verdict import figure
from service.core.protocol.models import Gate, Protocol, Step
from service.core.records.events import Event, GateVerdict, OperatorAction, RecordedView, SessionStarted
from service.core.run.expected import duration
from service.core.run.state import RunState, StepState
from service.monitor.snapshot import Snapshot
from service.web.page.run_words import gate_word, limit, planned_views

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
    step_done: int  # in the current step
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
    """Every gate of a step with what is known of it."""
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
    """Counted from the record; the time left from the times between this run's own exposures."""
    data_set = [s for s in protocol.steps if getattr(s.params, "purpose", "") == "dataset"]
    total = sum(planned_views(step) for step in data_set)
    done = sum(min(len(state.steps[step.id].captured), planned_views(step)) for step in data_set)
    here = protocol.step(state.current)
    step_total = planned_views(here)
    step_done = min(len(state.step.captured), step_total)
    intervals = view_intervals_s(events, state.current)
    if len(intervals) < 2:
        intervals = view_intervals_s(events)
    later = protocol.steps[protocol.index(state.current) :]
    views_left = sum(
        max(planned_views(step) - len(state.steps[step.id].captured), 0)
        for step in later
        if state.steps[step.id].phase != "passed"
    )
    each_s = median(intervals) if len(intervals) >= 2 else None
    return CaptureProgress(
        done=done,
        total=total,
        percent=100.0 * done / total if total else 0.0,
        left=_left(each_s, views_left),
        step_done=step_done,
        step_total=step_total,
        step_left=_left(each_s, step_total - step_done),
    )


def view_intervals_s(events: Sequence[Event], step: str | None = None) -> list[float]:
    """Seconds between two exposures of the same attempt of a step, without a restart or a person's act in between."""
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
    snapshot: Snapshot, space: Forecast | None = None, clocks: Sequence[ClockReading] = ()
) -> tuple[Reading, ...]:
    """What the runner last reported of the machine and the devices; what it did not report is shown as unknown.

    Args:
        snapshot: of the runner.
        space: what the run will still write, where it is known.
        clocks: as last compared; those beyond their limits are shown.
    """
    battery = snapshot.camera_battery_fraction
    return (
        _space("Disk", snapshot.disk_free_bytes, low_gib=20, out_gib=5) if space is None else _disk(space),
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


def _space(name: str, free_bytes: int | None, *, low_gib: float, out_gib: float) -> Reading:
    if free_bytes is None:
        return Reading(name, "unknown")
    gib = free_bytes / _GIB
    tone, note = ("stop", "nearly full") if gib < out_gib else ("attention", "low") if gib < low_gib else ("", "")
    return Reading(name, f"{gib:.0f} GiB free" if gib >= 10 else f"{gib:.1f} GiB free", tone, note)
