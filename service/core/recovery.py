"""What can be done about a failed step: the policy, the operator's choices with their time, loss and text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from statistics import median
from typing import Any, Literal

from service.core.gates import acceptance_refusal, demanded_role, dependent_steps, used_steps
from service.core.protocol import Protocol, Recovery, Step
from service.core.records.base import seconds_between
from service.core.records.run_events import OperatorVerb
from service.core.run.actions import redo_refusal, skip_refusal, unmet_requirements
from service.core.run.state import Mending, RunState, StepState

# `abort`: a person is asked, and to end the run is what is recommended. Only a person ends a run.
Policy = Literal["retry", "ask", "abort"]
MOST_WAITED_OUT = 5  # further tries of a step whose failures the computer's own want of processor time explains

# Names instead of classes, because core does not know the drivers and the events hold names.
# Transient errors: the same call may succeed in a moment. (The driver has already waited for a busy camera.)
TRIED_AGAIN = frozenset({"DeviceUnavailableError", "DeviceTimeoutError", "MachineBusyError", "StaleImageError"})
# Only a person can put these right, whatever the protocol says. (A damaged file of the evidence is restored from a
# copy; it is checked against its hash when it is read again.)
NEEDS_A_PERSON = frozenset(
    {
        "SafetyStopError",
        "LeaveNeededError",
        "ArmDepartedError",
        "ToolChangedError",
        "DriverKilledError",
        "DeviceChangedError",
        "DeviceStorageFullError",
        "IntegrityError",
        "ImagesSpoiltError",
        "SpaceShortError",
        "UnforeseenError",
    }
)


def recovery_policy(recovery: Recovery, error: str, failures: int, *, starved: bool = False) -> Policy:
    """Retry, or ask the operator.

    Args:
        recovery: the step's policy from the protocol.
        error: the class name of the error that ended the work.
        failures: the number of consecutive failures of the step, including this one (StepState.failures + 1).
        starved: the computer had no processor time for the work, which explains a device that was late.
    """
    if error in NEEDS_A_PERSON:
        return "ask"
    if error in TRIED_AGAIN and failures <= recovery.retries + (MOST_WAITED_OUT if starved else 0):
        return "retry"
    return recovery.on_failure


# Error class → what a person does before trying again. Every class in drivers/errors.py has an entry.
REMEDIES: Mapping[str, str] = {
    "DeviceError": "Check the device",
    "DeviceUnavailableError": "Check that the device is switched on and its cable or network is connected",
    "DeviceTimeoutError": "Check that the device is awake, or that the expected file has arrived",
    "MachineBusyError": "End what else this computer computes, or wait until it is done",
    "DriverKilledError": "End programs that are not needed on this computer, and look at the device",
    "DeviceChangedError": "Connect the device that was calibrated, or repeat the calibration with this one",
    "DeviceBusyError": "Wait until the device has finished what it is doing",
    "DeviceRefusedError": "Set the device as the message says",
    "DeviceFaultError": "Switch the device off and on; replace it if the fault remains",
    "DeviceStorageFullError": "Make room where the device stores its data, or insert another card",
    "SafetyStopError": "Check the robot and the people around it, then clear the stop at the robot",
    "LeaveNeededError": "Check that the robot stands as it should and nobody is within its reach",
    "ArmDepartedError": "Look at what moved the robot; from where it stands now its motions are planned anew",
    "ToolChangedError": "Ask who changed the tool or the payload at the pendant; the rig's own are set again",
    "UnreachablePoseError": "Move the obstacle, or the robot's base, so that the robot can reach the pose",
    "ReleasedElsewhereError": "Press the camera's own button, or connect a camera that the software can release",
    "StaleImageError": "Check the camera: it delivered an earlier image instead of a new one",
    "UnreadableFileError": "Export the file again, or use another one",
    "IncompleteExportError": "Wait until the export has ended, or export again with all files",
    "DriverMissingError": "Install the driver that the message names",
    "DataError": "Use another file; this one cannot be used",
    "ImagesSpoiltError": "Clean the lens, and check that its cap is off and the light is on",
    "ComputeError": "Put right what the message names, or take what is missing",
    "ConfigurationError": "Put right what the message names",
    "ProtocolError": "Put right what the message names",
    "StoreError": "Check the disk that holds the evidence: free space, cable, permissions",
    "SpaceShortError": "Make room on the disk of the data folder, as the message says",
    "UnforeseenError": "Put right what the message names; report it with the log",
    "IntegrityError": "Restore the damaged file from a copy; it is checked against its hash when it is read",
}
UNKNOWN_REMEDY = "Put right what the message names"


_WITH_WHAT_IS_THERE = "Judge it again with the existing images; single images are taken again on the page Capture"
Trouble = Literal["gates", "failure", "requirements"]


@dataclass(frozen=True, slots=True)
class WayOn:
    """One choice. The first available one of a list is recommended."""

    verb: OperatorVerb
    step: str  # the step concerned
    words: str
    minutes: float | None  # the time that it takes; None if not known in advance
    loses: str  # a phrase on what no longer counts afterwards
    available: bool = True
    why_not: str = ""


def trouble_of(protocol: Protocol, state: RunState) -> Trouble | None:
    """Return the reason why the current step is stopped; None while nothing stops it."""
    if not state.started or state.terminal:
        return None
    if state.phase == "recovering" and not state.step.retry_granted:
        return "gates" if state.step.failure is None else "failure"
    if state.phase == "ready" and unmet_requirements(protocol.step(state.current), state):
        return "requirements"
    return None


def ways_on(protocol: Protocol, state: RunState) -> tuple[WayOn, ...]:
    """Return every way on for a stopped run, the available ones first; empty while nothing stops it.

    Ending the run is always available. It is the last of the available ones, unless the protocol recommends it
    (`on_failure: abort`).
    """
    trouble = trouble_of(protocol, state)
    if trouble is None:
        return ()
    step = protocol.step(state.current)
    if trouble == "requirements":
        found = [_redo(protocol, state, name) for name in unmet_requirements(step, state)]
        found.append(_skip(protocol, state))
    else:
        again, redos = _again(protocol, state, trouble), _redos(protocol, state, step)
        same = trouble == "gates" and (step.repeated.same or _all_taken(step, state.step))
        found = [*redos, again] if same or _changed(state) else [again, *redos]
        found += [_accept(protocol, state)] if trouble == "gates" else []
        found.append(_skip(protocol, state))
    found.sort(key=lambda way: not way.available)  # stable
    done = [way for way in found if way.available]
    end, failure = _end(protocol, state), state.step.failure
    ends_first = trouble == "failure" and failure is not None and failure.recovery == "abort"
    possible = (end, *done) if ends_first else (*done, end)
    return (*possible, *_together(way for way in found if not way.available))


def _changed(state: RunState) -> bool:
    """Return whether another device answers than the calibrated one: another try would not make it the same."""
    return state.step.failure is not None and state.step.failure.error == "DeviceChangedError"


def planned_views(step: Step) -> int:
    """Return the number of images that the protocol plans for a step."""
    return sum(int(one.count) for one in planned_sets(step))


def planned_sets(step: Step) -> tuple[Any, ...]:
    """Return a step's sets of viewpoints and of planned board poses; each has `count` and `station`."""
    planned = getattr(step.params, "board_poses", None)
    listed: tuple[Any, ...] = getattr(step.params, "viewpoints", ()) or ()
    return listed if planned is None else (*listed, planned)


def view_s(protocol: Protocol, state: RunState, step: Step) -> float | None:
    """Return the seconds for one view: this run's median, else from the arm's plan; None if neither is known."""
    if state.view_gaps_s:
        return median(state.view_gaps_s)
    return state.steps[step.id].motion_plan.view_s


def takes_words(minutes: float | None) -> str:
    """Return a duration as text, such as `about 12 min`."""
    if minutes is None:
        return "not known"
    if minutes == 0:
        return "no time"
    return "under a minute" if minutes < 1 else f"about {minutes:.0f} min"


# --- one function per verb ---------------------------------------------------------------------------------


def _again(protocol: Protocol, state: RunState, trouble: Trouble) -> WayOn:
    step, now = protocol.step(state.current), state.step
    mend = now.mend or Mending()
    words = mend.advice or (_WITH_WHAT_IS_THERE if _all_taken(step, now) else step.repeated.words)
    if now.mend is None and trouble == "failure" and now.failure is not None:
        words = f"{REMEDIES.get(now.failure.error, UNKNOWN_REMEDY)}; then try again"
    mended = len(mend.viewpoints) + mend.images
    left = mended or max(planned_views(step) - len(now.captured), 0)
    each_s = view_s(protocol, state, step)
    minutes = _minutes(now.worked_s)
    if left and each_s is not None:
        minutes = left * each_s / 60
    elif now.captured and planned_views(step):
        minutes = _computing(now.worked_s, len(now.captured), each_s)
    kept = {0: "", 1: " The image is kept."}.get(len(now.captured), f" The {len(now.captured)} images are kept.")
    return WayOn("confirm", step.id, words, minutes, f"Nothing.{kept}")


def _computing(worked_s: float | None, views: int, each_s: float | None) -> float | None:
    """Return the minutes of computing after the views are taken: the work so far less the time for `views`."""
    return None if worked_s is None or each_s is None else max(worked_s - views * each_s, each_s) / 60


def _all_taken(step: Step, now: StepState) -> bool:
    """Return whether every planned view is taken and the step suggests no others: a retry would change no figure."""
    return now.mend is None and 0 < planned_views(step) <= len(now.captured)


def _redos(protocol: Protocol, state: RunState, step: Step) -> list[WayOn]:
    """Redo this step or an earlier one that it uses: first those that change the figures, then the nearest."""
    used = sorted(used_steps(protocol, step), key=protocol.index, reverse=True)
    used.sort(key=lambda name: protocol.step(name).repeated.same and not protocol.step(name).irreversible)
    begun = [name for name in used if state.steps[name].phase != "pending"]
    afresh = [step.id] if state.step.captured or step.irreversible else []
    return [_redo(protocol, state, name) for name in (*afresh, *begun)]


def _together(ways: Iterable[WayOn]) -> Iterator[WayOn]:
    """Merge neighbouring ways that are refused for the same reason into one."""
    for _, group in groupby(ways, key=lambda way: way.why_not):
        first, *others = group
        yield replace(first, words=", ".join([first.words, *(way.words.split(": ", 1)[-1] for way in others)]))


def _redo(protocol: Protocol, state: RunState, target: str) -> WayOn:
    steps = protocol.steps[protocol.index(target) : protocol.index(state.current) + 1]
    begun = [s for s in steps if state.steps[s.id].started_utc]
    images = sum(len(state.steps[s.id].captured) for s in begun)
    reset = [s.title for s in begun if s.id != target]
    title = protocol.step(target).title
    lost = ["1 image no longer counts" if images == 1 else f"{images} images no longer count"] if images else []
    lost += [f"These are done again as well: {', '.join(reset)}"] if reset else []
    loses = ". ".join([*lost, "All of it stays in the record"]) + "." if lost else "Nothing."
    afresh = (
        "Do this step again from its beginning" if target == state.current else f"Do an earlier step again: {title}"
    )
    refusal = redo_refusal(protocol, state, target)
    minutes = _sum(_minutes(_took_s(protocol, state, s)) for s in (begun or [protocol.step(target)]))
    return WayOn("redo", target, afresh, minutes, loses, refusal is None, "" if refusal is None else refusal.what)


def _accept(protocol: Protocol, state: RunState) -> WayOn:
    step, refusal = protocol.step(state.current), acceptance_refusal(protocol, state)
    rest = [protocol.step(name).title for name in dependent_steps(protocol, step.id)]
    says = f" The results of these will say that they depend on it: {', '.join(rest)}." if rest else ""
    role = demanded_role(protocol, state) or "supervisor"
    return WayOn(
        "accept",
        step.id,
        f"Accept the figures as they are: a {role} signs, with a reason",
        1.0,
        f"The figures stay outside their limits: a deviation that every report states first.{says}",
        refusal is None,
        "" if refusal is None else refusal.what,
    )


def _skip(protocol: Protocol, state: RunState) -> WayOn:
    step, refusal = protocol.step(state.current), skip_refusal(protocol, state)
    later = protocol.steps[protocol.index(step.id) + 1 :]
    blocked = [s.title for s in later if step.id in s.requires]
    unjudged = [g.measure for s in later for g in s.gates if g.unless_skipped == step.id]
    using = [s.title for s in later if step.id in used_steps(protocol, s)]
    lost = ["Its result does not count"]
    lost += [f"These cannot begin: {', '.join(blocked)}"] if blocked else []
    lost += [f"Not judged later: {', '.join(dict.fromkeys(unjudged))}"] if unjudged else []
    lost += [f"These go on without it, as far as they can: {', '.join(using)}"] if using else []
    why_not = "" if refusal is None else refusal.what
    return WayOn("skip", step.id, "Go on without this step", 0.0, ". ".join(lost) + ".", refusal is None, why_not)


def _end(protocol: Protocol, state: RunState) -> WayOn:
    left = [s.title for s in protocol.steps if state.steps[s.id].phase != "passed"]
    undone = f"{left[0]}, and {len(left) - 1} later steps" if len(left) > 2 else ", ".join(left)
    loses = (
        "Nothing that is recorded: it is sealed and can be read, verified, reported and exported. "
        f"Not done: {undone}. The run cannot go on."
    )
    return WayOn("abort", state.current, "End the run here and keep what there is", 0.0, loses)


# --- durations -------------------------------------------------------------------------------------------------


def _took_s(protocol: Protocol, state: RunState, step: Step) -> float | None:
    """Return the seconds for doing a step: estimated from the time per view, else what it took; None: not known."""
    now = state.steps[step.id]
    each_s, views = view_s(protocol, state, step), planned_views(step)
    if views and each_s is not None:
        return views * each_s
    if now.started_utc and now.ended_utc:
        return seconds_between(now.started_utc, now.ended_utc)
    return now.worked_s


def _minutes(seconds: float | None) -> float | None:
    return None if seconds is None else seconds / 60


def _sum(parts: Iterable[float | None]) -> float | None:
    known = list(parts)
    return None if any(part is None for part in known) else sum(part for part in known if part is not None)
