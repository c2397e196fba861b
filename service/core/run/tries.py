"""What a run says while it tries again by itself: what failed, how often, why, and when the next try begins."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta

from service.core.errors import what_of
from service.core.protocol.models import Protocol
from service.core.run.actions import needs_leave
from service.core.run.state import FailedTries, RunState
from service.core.text.clock_time import time_utc

_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
_TIMES = ("never", "once", "twice")


def tries_words(protocol: Protocol, state: RunState, clock: Callable[[str], str] = time_utc) -> str:
    """`b001 failed twice: no file within 46 s; third try at 20:41:07 UTC`, while the run tries again by itself.

    "" where nothing has failed, or where a person decides whether there is another try.

    Args:
        protocol: of the run.
        state: of the run.
        clock: a recorded time in words.
    """
    tries, now = state.step.tries, state.step
    if tries is None or state.status != "active" or needs_leave(protocol, state):
        return ""
    if now.phase == "recovering":
        if now.failure is None or now.failure.recovery != "retry":
            return ""
        wait = timedelta(seconds=protocol.step(now.step).recovery.wait_s)
        begins_utc = (datetime.fromisoformat(now.failure.at_utc or tries.at_utc) + wait).isoformat()
        return f"{failed_words(tries)}; {_ordinal(tries.times + 1)} try at {clock(begins_utc)}, by itself"
    if now.phase != "running":
        return ""
    since_utc = max(tries.at_utc, now.work_began_utc)
    return f"{failed_words(tries)}; {_ordinal(tries.times + 1)} try since {clock(since_utc)}, by itself"


def failed_words(tries: FailedTries) -> str:
    """`b001 failed twice: no file within 46 s`; without place and remedy, which the record has."""
    times = _TIMES[tries.times] if tries.times < len(_TIMES) else f"{tries.times} times"
    return f"{tries.what or 'The step'} failed {times}: {what_of(tries.message)}"


def _ordinal(number: int) -> str:
    return _ORDINALS[number - 1] if number <= len(_ORDINALS) else f"{number}th"
