"""Timing figures of a recorded run: its steps, the overhead per viewpoint beyond arm and camera, and its jobs."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from datetime import datetime
from itertools import pairwise
from typing import Any

import numpy as np

from service.compute.planning.motion_plan import turn_times_s
from service.core.protocol import Protocol
from service.core.records.events import Event
from service.core.records.run_events import JobFinished, RunCompleted, StepPassed, StepStarted, ViewpointCaptured
from service.dataset.summary import RunSummary

_PATIENCE_S = 3.0  # a longer overhead is a pause, a retry or another part of the step


def run_figures(summary: RunSummary, speed_up: float = 1.0) -> dict[str, Any]:
    """All timing figures in a run's record. `speed_up` is the factor by which the simulated arm is too fast."""
    return {
        "views": sum(isinstance(e.payload, ViewpointCaptured) for e in summary.events),
        "steps_s": steps_s(summary.events),
        "overhead_s": overhead(summary.events, summary.protocol, speed_up),
        "after_the_scan_s": after_the_scan_s(summary),
        "jobs_s": jobs_s(summary.events),
    }


def seconds_between(first: Event, last: Event) -> float:
    """Wall time between two events, in seconds."""
    a, b = (datetime.fromisoformat(event.at_utc) for event in (first, last))
    return (b - a).total_seconds()


def steps_s(events: Sequence[Event]) -> dict[str, float]:
    """Time from the first start of each step until it passed, including waits for people."""
    begun: dict[str, Event] = {}
    took: dict[str, float] = {}
    for event in events:
        match event.payload:
            case StepStarted(step=step):
                begun.setdefault(step, event)
            case StepPassed(step=step) if step in begun:
                took[step] = round(seconds_between(begun[step], event), 1)
            case _:
                pass
    return took


def overhead(events: Iterable[Event], protocol: Protocol, speed_up: float) -> dict[str, float]:
    """Seconds between two exposures that are not spent on arm, camera or the protocol's waits.

    Arm: the motion time of the joint that turns furthest, at the protocol's speed and acceleration, plus its ringing.
    Camera: from the release until it announces the last file. Waits: the settle window and the dwell time.
    """
    motion, settle = protocol.motion, protocol.settle
    shots = [e.payload for e in events if isinstance(e.payload, ViewpointCaptured)]
    spent: list[float] = []
    for before, after in pairwise(shots):
        if (before.step, before.attempt, before.station) != (after.step, after.attempt, after.station):
            continue
        turn_rad = np.max(np.abs(np.array(after.joints_rad) - np.array(before.joints_rad)))
        travel_s = float(turn_times_s(turn_rad, motion.speed_rad_s, motion.acceleration_rad_s2))
        camera_s = before.arrival_monotonic_s - before.trigger_monotonic_s
        cycle_s = after.trigger_monotonic_s - before.trigger_monotonic_s
        waits_s = after.ringing_s + settle.window_s + motion.dwell_s
        spent.append(cycle_s - camera_s - travel_s / speed_up - waits_s)
    usual = [s for s in spent if s < _PATIENCE_S]
    if not usual:
        return {}
    return {
        "pairs": len(spent),
        "longer_pauses": len(spent) - len(usual),
        "median": round(statistics.median(usual), 3),
        "mean": round(statistics.fmean(usual), 3),
        "worst": round(max(usual), 3),
    }


def after_the_scan_s(summary: RunSummary) -> dict[str, float]:
    """Time from the end of the last scan until each later step passed, the run ended, and the last job finished."""
    scans = {step.id for step in summary.protocol.steps if step.kind == "scan_import"}
    passed = [e for e in summary.events if isinstance(e.payload, StepPassed) and e.payload.step in scans]
    if not passed:
        return {}
    scan = passed[-1]
    after: dict[str, float] = {}
    for event in summary.events:
        if event.seq <= scan.seq:
            continue
        match event.payload:
            case StepPassed(step=step):
                after[step] = round(seconds_between(scan, event), 1)
            case RunCompleted():
                after["run completed"] = round(seconds_between(scan, event), 1)
            case JobFinished():
                after["last result"] = round(seconds_between(scan, event), 1)
            case _:
                pass
    return after


def jobs_s(events: Iterable[Event]) -> dict[str, dict[str, float]]:
    """Number and total duration of the jobs of each kind."""
    kinds: dict[str, list[float]] = {}
    for event in events:
        if isinstance(event.payload, JobFinished):
            kinds.setdefault(event.payload.job_kind, []).append(event.payload.duration_s)
    return {kind: {"jobs": len(took), "seconds": round(sum(took), 1)} for kind, took in sorted(kinds.items())}
