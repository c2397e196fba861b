"""The robot banner: what every page of a run says of its robots; what is not known is shown as unknown."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Literal

from service.core.run.state import Loss, RunState, connected_arms, lost_arms
from service.core.words import time_here
from service.monitor.snapshot import STALE_S, Snapshot

Tone = Literal["moving", "standing", "paused", "unknown", "stop"]
NOT_THE_STOP = "This screen is not the emergency stop."
_TAKE_IT = "Robot: take it as moving."
_FROM_OUTSIDE = "If it moves, press the emergency stop."
_AS_MOVING = "It counts as moving until a person has looked: stay outside of its reach."
_TOLD_NOW = {"standing": "It reports now that it stands still.", "not_connected": "It is not connected now."}
_AT_THE_ROBOT = "This software cannot clear a stop; a person does it at the robot, and nothing moves again by itself."


@dataclass(frozen=True, slots=True)
class LookAt:
    """An arm that a person is asked to look at, and the event that this answers."""

    arm: str  # name in rig.yaml
    lost_seq: int


@dataclass(frozen=True, slots=True)
class Banner:
    """The state of the robot as text."""

    key: str  # moving, standing, paused, pausing, protective_stop …
    tone: Tone
    icon: str
    title: str
    text: str
    remedy: str = ""  # the thing that a person does at the robot
    assertive: bool = False  # screen readers interrupt for it
    look: tuple[LookAt, ...] = ()  # the losses that a person can say here to have looked at


LOST = Banner(
    "unknown",
    "unknown",
    "unknown",
    "Robots: unknown.",
    f"The connection to the service is lost. Take every robot as moving. {NOT_THE_STOP}",
)


def robot_banner(
    state: RunState, snapshot: Snapshot, now_utc_s: float, *, driven: bool, tries: str = "", moves: bool = True
) -> Banner:
    """Return what to say of the robot; what is not known for certain is shown as unknown.

    Args:
        state: the run's state.
        snapshot: the last report of the program that drives it.
        now_utc_s: now, in seconds since the epoch.
        driven: true if that program runs.
        tries: a text on what failed and is tried again by itself; "" for nothing.
        moves: true if the present step moves the robot.
    """
    lost = lost_arms(state)
    banner = _present(state, snapshot, now_utc_s, tries, driven=driven, moves=moves)
    if not lost:
        return banner
    look = tuple(LookAt(name, loss.seq) for name, loss in lost.items())
    words = " ".join(_loss_words(name, loss) for name, loss in lost.items())
    if banner.tone in ("stop", "moving") or banner.key == "pausing":
        return replace(banner, text=f"{banner.text} {words} {_AS_MOVING}", look=look)
    told = _TOLD_NOW.get(snapshot.robot, "")
    now = (told, _now(snapshot)) if driven and not state.terminal else ()
    text = _joined(_ended(state), words, *now, _AS_MOVING, _FROM_OUTSIDE, NOT_THE_STOP)
    return Banner("lost", "unknown", "unknown", _TAKE_IT, text, assertive=True, look=look)


def _joined(*sentences: str) -> str:
    """Return sentences one after the other, without those that are ""."""
    return " ".join(filter(None, sentences))


def _ended(state: RunState) -> str:
    return "The run has ended." if state.terminal else ""


def _now(snapshot: Snapshot) -> str:
    """Return what the program does now, if it takes long."""
    busy = busy_words(snapshot)
    return f"Now: {busy}." if busy else ""


def _again(tries: str) -> str:
    return f"{tries}." if tries else ""


def _loss_words(name: str, loss: Loss) -> str:
    since = time_here(loss.since_utc)
    return f"The connection to {name} was lost at {since}, {loss.how}; nobody has looked at it since."


def _present(  # noqa: PLR0911 - one return a case
    state: RunState, snapshot: Snapshot, now_utc_s: float, tries: str, *, driven: bool, moves: bool
) -> Banner:
    """Return what to say of the robot as if every loss of a connection had been seen to."""
    if snapshot.doing in ("unknown", "ended") and not driven and connected_arms(state) and _left(state, snapshot):
        return _left_alone(state, snapshot)
    if state.terminal:
        return Banner("ended", "standing", "end", "The run has ended.", "It drives no robot any more.")
    if snapshot.doing in ("unknown", "ended"):
        return _silent(snapshot, now_utc_s, driven=driven)
    if snapshot.doing == "starting" and connected_arms(state):
        text = f"The program that drove it has ended, and starts again. {_AS_MOVING} {NOT_THE_STOP}"
        return Banner("lost", "unknown", "unknown", _TAKE_IT, text)
    if snapshot.doing == "starting":
        text = f"It has moved nothing yet, and asks before it does. {NOT_THE_STOP}"
        return Banner("starting", "standing", "open", "The program that drives the robot is starting.", text)
    if snapshot.robot_silent_s > STALE_S and snapshot.robot != "not_connected":
        return _not_heard_of(snapshot)
    stop = _STOPS.get(snapshot.robot)
    if stop is not None:
        return stop
    if snapshot.robot == "moving":
        return _moving(state, snapshot, tries)
    if snapshot.robot == "not_connected":
        return _not_connected(state, snapshot, tries)
    if state.paused:
        if snapshot.doing == "paused":
            return Banner(
                "paused", "paused", "pause", "Paused. The robot stands still.", "It moves only after Resume."
            )
        return Banner("pausing", "paused", "pause", "Pausing…", "The robot may still move. Wait for Paused.")
    if snapshot.doing != "working":
        return Banner("standing", "standing", "standing", "The robot stands still.", NOT_THE_STOP)
    may = "It may move at any moment." if moves else f"This step does not move it. {NOT_THE_STOP}"
    text = _joined(_again(tries), _busy(snapshot), may)
    return Banner("standing", "standing", "standing", "The robot stands still.", text)


def _not_connected(state: RunState, snapshot: Snapshot, tries: str) -> Banner:
    """Return the banner while no arm is connected: never yet, not any more, or because it could not be."""
    title = "Paused. The robot is not connected." if state.paused else "Robot not connected."
    if connected_arms(state):
        text = f"It was connected, and is being connected again. Take it as moving. {NOT_THE_STOP}"
        return Banner("unknown", "unknown", "unknown", title, text)
    said: list[str] = []
    for name, arm in state.arms.items():
        if arm.seen_utc:
            lost, seen = time_here(arm.lost_utc), time_here(arm.seen_utc)
            said.append(f"The connection to {name} was lost at {lost}; {arm.seen_by} looked at it at {seen}.")
        if arm.refused_utc:
            said.append(f"{name} could not be connected at {time_here(arm.refused_utc)}: {arm.refused_why}.")
    why = " ".join(said) or "Nothing has needed it so far."
    text = _joined(_again(tries), why, _now(snapshot), "Its own pendant can still move it.")
    return Banner("not_connected", "paused" if state.paused else "standing", "open", title, text)


def _left(state: RunState, snapshot: Snapshot) -> bool:
    """Return whether the program that drove the run ended without closing its connections in an orderly way."""
    return not state.terminal or (snapshot.doing == "unknown" and snapshot.at_utc_s > 0)


def _left_alone(state: RunState, snapshot: Snapshot) -> Banner:
    """Return the banner if the program ended while arms were connected, which the record shows only later."""
    arms = connected_arms(state)
    at_utc = datetime.fromtimestamp(snapshot.at_utc_s, UTC).isoformat() if snapshot.at_utc_s else state.at_utc
    told = (
        f"The program that drove {' and '.join(arms)} does not run; it was last heard from at {time_here(at_utc)}, "
        "and nobody has looked since."
    )
    text = _joined(_ended(state), told, _AS_MOVING, _FROM_OUTSIDE, NOT_THE_STOP)
    look = tuple(LookAt(name, 0) for name in arms)
    return Banner("lost", "unknown", "unknown", _TAKE_IT, text, assertive=True, look=look)


def busy_words(snapshot: Snapshot) -> str:
    """Return what the program is doing, and for how long; "" if it does not take long.

    A call without a description of its own is described by the work it belongs to, so that a hang is visible.
    """
    if snapshot.lasting:
        return f"{snapshot.activity}, for {snapshot.activity_s:.0f} s{_starved(snapshot)}"
    if snapshot.quiet_s > STALE_S:
        what = snapshot.what or "something that it does not report"
        return f"{what}, for {snapshot.quiet_s:.0f} s{_starved(snapshot)}"
    return ""


def _starved(snapshot: Snapshot) -> str:
    """Say that the computer is too busy, where that is a good part of the time."""
    if snapshot.starved_s < max(1.0, 0.2 * snapshot.quiet_s):
        return ""
    return f", of which it waited {snapshot.starved_s:.0f} s for a processor"


def _busy(snapshot: Snapshot) -> str:
    now = _now(snapshot)
    if not now:
        return "A step is under way."
    return _joined(now, "It hears no button before that is done." if snapshot.quiet_s > STALE_S else "")


def _not_heard_of(snapshot: Snapshot) -> Banner:
    text = (
        f"It has not been heard of for {snapshot.robot_silent_s:.0f} s; the program that drives it is still at "
        f"{busy_words(snapshot) or 'its work'}. Look at the robot. {NOT_THE_STOP}"
    )
    return Banner("unknown", "unknown", "unknown", "Robot: unknown.", text)


def _silent(snapshot: Snapshot, now_utc_s: float, *, driven: bool) -> Banner:
    if driven:
        title = "Robot: unknown."
        age = snapshot.age_s(now_utc_s)
        spoke = f" for {age:.0f} s" if age >= 0 else " since the clock was set back"
        since = spoke if snapshot.at_utc_s else " yet"
        last = f" The last word was: {snapshot.activity}." if snapshot.activity else ""
        text = f"The program that drives it has not told anything{since}.{last} Look at the robot."
    else:
        title, text = "Robot: unknown.", "The program that drives it does not run. Look at the robot."
    return Banner("unknown", "unknown", "unknown", title, f"{text} {NOT_THE_STOP}")


def _moving(state: RunState, snapshot: Snapshot, tries: str) -> Banner:
    if state.paused or snapshot.doing in ("pausing", "paused"):
        return Banner("pausing", "paused", "pause", "Pausing…", "The robot still moves. Wait for Paused.")
    speed = "" if snapshot.speed_fraction is None else f"Speed slider {snapshot.speed_fraction:.0%}."
    text = _joined("Stay outside of its reach.", _again(tries), speed, _now(snapshot), NOT_THE_STOP)
    return Banner("moving", "moving", "moving", "The robot moves.", text)


_STOPS: dict[str, Banner] = {
    "emergency_stop": Banner(
        "emergency_stop",
        "stop",
        "stop",
        "Emergency stop.",
        "The robot is stopped and without power. What was captured is safe.",
        "Make sure that nobody is in danger and find out why it was pressed. Then, at the robot: release the "
        "emergency stop button, confirm on the teach pendant, switch the arm on and release its brakes. "
        + _AT_THE_ROBOT,
        assertive=True,
    ),
    "protective_stop": Banner(
        "protective_stop",
        "stop",
        "stop",
        "Protective stop.",
        "The robot stopped itself: it touched something, or a limit was near. What was captured is safe.",
        "Look at what it touched and clear its path. Check that specimen, spheres and camera have not moved. Then, "
        "on the teach pendant: wait 5 s and choose Enable robot. " + _AT_THE_ROBOT,
        assertive=True,
    ),
    "safeguard_stop": Banner(
        "safeguard_stop",
        "stop",
        "stop",
        "Safeguard stop.",
        "A door, a light curtain or a scanner holds the robot. What was captured is safe.",
        "Leave the guarded area, close it and reset the safeguard at the robot. " + _AT_THE_ROBOT,
        assertive=True,
    ),
    "fault": Banner(
        "fault",
        "stop",
        "stop",
        "The robot reports a fault.",
        "It does not move. What was captured is safe.",
        "Read the log on the teach pendant and do what it asks for; restart the arm there. " + _AT_THE_ROBOT,
        assertive=True,
    ),
    "unknown": Banner(
        "unknown",
        "unknown",
        "unknown",
        "Robot: unknown.",
        f"It does not answer. Take it as moving and stay outside of its reach. {NOT_THE_STOP}",
        "Check that the controller is switched on and its network cable is in. The software goes on asking it.",
        assertive=True,
    ),
}
