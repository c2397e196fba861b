"""What is said of a step that works by itself: how long it takes, when that is not normal, what it tries again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import median

from service.core.errors import what_of
from service.core.protocol import Protocol, Step
from service.core.recovery import planned_views, view_s
from service.core.run.actions import needs_leave
from service.core.run.state import FailedTries, RunState, StepState
from service.core.words import time_utc

_TOO_LONG = 1.5  # times what is usual, and longer than ever before
_SHORT_S = 20.0  # nobody leaves for less
EarlierTimes = Mapping[str, Sequence[float]]  # step → seconds that its work took in earlier runs of this site


@dataclass(frozen=True, slots=True)
class UsualTime:
    """The usual duration of a step's work, and the source of this knowledge."""

    seconds: float
    longest_s: float
    source: str  # a phrase that stands in brackets


def usual_time(protocol: Protocol, state: RunState, step: Step, earlier: EarlierTimes) -> UsualTime | None:
    """Return how long a step usually takes; None if that is not known.

    Earlier runs of this site say it; before the first, the protocol or the time for a view does.
    """
    known = earlier.get(step.id, ())
    if known:
        runs = f"{len(known)} earlier runs" if len(known) > 1 else "one earlier run"
        return UsualTime(median(known), max(known), f"{runs} on this site")
    if step.takes_s is not None:
        return UsualTime(step.takes_s, step.takes_s, "by the protocol")
    each_s, views = view_s(protocol, state, step), planned_views(step)
    if each_s is None or not views:
        return None
    return UsualTime(each_s * views, each_s * views, f"{views} views")


def work_words(
    protocol: Protocol, state: RunState, earlier: EarlierTimes, now_utc: str, clock: Callable[[str], str]
) -> str:
    """Say how long the work under way usually takes, and if it has taken too long; "" while none is under way."""
    now = state.step
    if state.status != "active" or now.phase != "running" or needs_leave(protocol, state) or not now.work_began_utc:
        return ""
    step = protocol.step(now.step)
    if step.by_hand:  # as long as the person takes
        return ""
    usual = usual_time(protocol, state, step, earlier)
    if usual is None:
        return f"Started at {clock(now.work_began_utc)}; how long it takes is not known yet on this site."
    took_s = now.work_s(now_utc)
    said = f"Usually {duration(usual.seconds)} ({usual.source}); started at {clock(now.work_began_utc)}"
    if took_s > max(_TOO_LONG * usual.seconds, usual.longest_s):
        longest = duration(usual.longest_s)
        most = "" if usual.longest_s == usual.seconds else f", and longer than ever before ({longest})"
        worked = "It has worked for" if now.waited_s else "That is"
        return (
            f"{said}. {worked} {duration(took_s)}{'' if now.waited_s else ' ago'}{most}: not normal any more. "
            "Look at what the banner says it waits for, at that device, and whether a worker computes."
        )
    until_utc = (datetime.fromisoformat(now_utc) + timedelta(seconds=usual.seconds - took_s)).isoformat()
    return f"{said}, so until about {clock(until_utc)}."


def away_words(
    protocol: Protocol, state: RunState, earlier: EarlierTimes, now_utc: str, clock: Callable[[str], str]
) -> str:
    """Return until when nobody is needed, if all goes as usual; "" if somebody is needed now or before long."""
    now = state.step
    if state.status != "active" or now.phase not in ("running", "checking") or needs_leave(protocol, state):
        return ""
    if protocol.step(now.step).by_hand:
        return ""
    left_s, unknown = 0.0, ""
    for step in protocol.steps[protocol.index(now.step) :]:
        here = step.id == now.step
        if not here and step.begins_confirmed:
            break
        usual = usual_time(protocol, state, step, earlier)
        if usual is None:
            unknown = step.title
            break
        left_s += _left_s(usual, now if here else None, now_utc)
        if step.sign:
            break
    if left_s < _SHORT_S:
        return ""
    until = clock((datetime.fromisoformat(now_utc) + timedelta(seconds=left_s)).isoformat())
    least = f"at least until about {until}: how long “{unknown}” takes is not known" if unknown else f"until {until}"
    return f"You can leave {least}. A fault asks for you earlier: switch alerts on."


def step_words(protocol: Protocol, state: RunState, step: Step, earlier: EarlierTimes) -> str:
    """Say how long a step that is still to be done usually takes; "" where that is not known, or the step is done."""
    usual = usual_time(protocol, state, step, earlier)
    if state.terminal or usual is None or state.steps[step.id].phase == "passed":
        return ""
    return f"Usually takes {duration(usual.seconds)} ({usual.source})."


def run_words(protocol: Protocol, state: RunState, earlier: EarlierTimes, now_utc: str) -> str:
    """Say how long the work that is left of a run usually takes, without the times for which it waits for people."""
    if state.terminal:
        return ""
    left_s, known = 0.0, 0
    left = [step for step in protocol.steps if state.steps[step.id].phase != "passed"]
    for step in left:
        usual = usual_time(protocol, state, step, earlier)
        if usual is None:
            continue
        known += 1
        now = state.steps[step.id]
        left_s += _left_s(usual, now if now.phase == "running" else None, now_utc)
    if not known:
        return ""
    part = "" if known == len(left) else f", of {known} of the {len(left)} steps left"
    return f"Work left{part}: about {duration(left_s)}, and the time for which the run waits for people."


def _left_s(usual: UsualTime, now: StepState | None, now_utc: str) -> float:
    """Return the seconds that the work of a step usually still takes; all of them where it is not under way."""
    if now is None or not now.work_began_utc:
        return usual.seconds
    return max(0.0, usual.seconds - now.work_s(now_utc))


def duration(seconds: float) -> str:
    """Return `40 s`, `12 min`, `1 h 05 min`."""
    if seconds < 90:
        return f"{max(round(seconds / 5) * 5, 5)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


_TIMES = ("never", "once", "twice")


def tries_words(protocol: Protocol, state: RunState, clock: Callable[[str], str] = time_utc) -> str:
    """Return `b001 failed twice: no file within 46 s; try 3 at 20:41:07 UTC` while the run tries again by itself.

    The text is "" where nothing has failed, or where a person decides whether there is another try.

    Args:
        protocol: the run's protocol.
        state: the run's state.
        clock: turns a recorded time into text.
    """
    tries, now = state.step.tries, state.step
    if tries is None or state.status != "active" or needs_leave(protocol, state):
        return ""
    if now.phase == "recovering":
        if now.failure is None or now.failure.recovery != "retry":
            return ""
        wait = timedelta(seconds=protocol.step(now.step).recovery.wait_s)
        begins_utc = (datetime.fromisoformat(now.failure.at_utc or tries.at_utc) + wait).isoformat()
        return f"{failed_words(tries)}; try {tries.times + 1} at {clock(begins_utc)}, by itself"
    if now.phase != "running":
        return ""
    since_utc = max(tries.at_utc, now.work_began_utc)
    return f"{failed_words(tries)}; try {tries.times + 1} since {clock(since_utc)}, by itself"


def failed_words(tries: FailedTries) -> str:
    """Return `b001 failed twice: no file within 46 s`; without place and remedy, which the record has."""
    times = _TIMES[tries.times] if tries.times < len(_TIMES) else f"{tries.times} times"
    return f"{tries.what or 'The step'} failed {times}: {what_of(tries.message)}"
