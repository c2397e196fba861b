"""The frame of every page of a run: its name, its navigation, the robot banner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.core.errors import OrthocaptureError
from service.core.protocol.models import Protocol
from service.core.records.events import RunStarted
from service.core.records.import_list import imported_sentence
from service.core.run.decide import AskOperator, decide
from service.core.run.state import RunState
from service.monitor.snapshot import STALE_S, STOPS, Snapshot, Standing, read_snapshot
from service.web.page.run_words import stopped_words
from service.web.site import Site

Tone = Literal["moving", "standing", "paused", "unknown", "stop"]
NOT_THE_STOP = "This screen is not the emergency stop."
_AT_THE_ROBOT = "This software cannot clear a stop; a person does it at the robot, and nothing moves again by itself."


@dataclass(frozen=True, slots=True)
class Banner:
    """The state of the robot, in words."""

    key: str  # moving, standing, paused, pausing, protective_stop …
    tone: Tone
    icon: str
    title: str
    text: str
    remedy: str = ""  # what a person does at the robot
    assertive: bool = False  # screen readers interrupt for it


@dataclass(frozen=True, slots=True)
class Attention:
    """What a screen reports by sound and notification, if alerts are switched on there."""

    key: Standing = "works"
    words: str = ""


@dataclass(frozen=True, slots=True)
class Tab:
    """A page of a run."""

    href: str
    text: str
    below: bool = False  # also the current one on pages below it


@dataclass(frozen=True, slots=True)
class RunFrame:
    """What base.html.j2 needs to know about a run."""

    run_id: str
    name: str
    protocol_id: str
    protocol_version: str
    protocol_sha256: str
    simulated: bool
    imported: str  # the sentence that says so; "" for a run that captures its photographs itself
    live: bool  # not ended, so there may be new events
    pausable: bool
    attention: Attention
    banner: Banner
    tabs: tuple[Tab, ...]


def run_frame(site: Site, run_id: str) -> RunFrame:
    """The frame of a run's pages. Raises UnknownRunError."""
    log = site.run(run_id)
    root = log.events[0].payload
    assert isinstance(root, RunStarted)  # checked when the run was read
    here = f"/runs/{run_id}"
    now_utc_s = site.store.clock.utc_s()
    driven, snapshot = site.launcher.driven(run_id), read_snapshot(site.data, run_id, now_utc_s)
    return RunFrame(
        run_id=run_id,
        name=run_id,
        protocol_id=root.protocol_id,
        protocol_version=root.protocol_version,
        protocol_sha256=root.protocol_sha256,
        simulated=root.simulated,
        imported=imported_sentence(log.events[0].at_utc, root.operator) if root.origin == "imported" else "",
        live=not log.state.terminal,
        pausable=log.state.status == "active" and driven,
        attention=_attention(log.protocol, log.state, snapshot, driven=driven),
        banner=robot_banner(log.state, snapshot, now_utc_s, driven=driven),
        tabs=(
            Tab(here, "Step"),
            Tab(f"{here}/capture", "Capture"),
            Tab(f"{here}/scene", "3D view"),
            Tab(f"{here}/calibration", "Calibration"),
            Tab(f"{here}/dataset", "Data set"),
            Tab(f"/audit/runs/{run_id}", "Audit", below=True),
        ),
    )


def _attention(  # noqa: PLR0911 - one return a case
    protocol: Protocol, state: RunState, snapshot: Snapshot, *, driven: bool
) -> Attention:
    """The state of a run for alerts on other pages. It is read from the record, so a dead runner is reported too."""
    if state.terminal:
        return Attention("ended", f"The run is {state.status}.")
    if not driven:
        return Attention("stopped", "The program that drives the robot does not run.")
    if snapshot.robot in STOPS:
        return Attention("stopped", f"The robot reports: {snapshot.robot.replace('_', ' ')}.")
    if state.paused:
        return Attention("waits", "The run is paused.")
    question = decide(protocol, state)
    if not isinstance(question, AskOperator):
        return Attention()
    title = protocol.step(question.step).title
    if question.for_ == "recovery":
        return Attention("stopped", f"{title}: {stopped_words(protocol, state, question)}.")
    due = "a signature is due" if question.for_ == "sign" else "your confirmation is awaited"
    return Attention("waits", f"{title}: {due}.")


def driven_frames(site: Site, *, but: str = "") -> list[RunFrame]:
    """The frames of all runs that a living process drives now, for the banners of pages that are not theirs.

    Never raises: a run whose state cannot be read is shown as unknown.

    Args:
        site: the site.
        but: a run to leave out, because the page has its banner already; "" for none.
    """
    try:
        driven = [run_id for run_id in site.launcher.driven_runs() if run_id != but]
    except OrthocaptureError:
        return [_unreadable("")]
    return [_frame_or_unknown(site, run_id) for run_id in driven]


def _frame_or_unknown(site: Site, run_id: str) -> RunFrame:
    try:
        return run_frame(site, run_id)
    except OrthocaptureError:
        return _unreadable(run_id)


def _unreadable(run_id: str) -> RunFrame:
    text = f"The record cannot be read now. Look at the robot. {NOT_THE_STOP}"
    banner = Banner("unknown", "unknown", "unknown", "Robot: unknown.", text)
    return RunFrame(
        run_id, run_id, "", "", "", simulated=False, imported="", live=False, pausable=False, attention=Attention(),
        banner=banner, tabs=(),
    )  # fmt: skip


LOST = Banner(
    "unknown",
    "unknown",
    "unknown",
    "Robots: unknown.",
    f"The connection to the service is lost. Take every robot as moving. {NOT_THE_STOP}",
)


def robot_banner(state: RunState, snapshot: Snapshot, now_utc_s: float, *, driven: bool) -> Banner:  # noqa: PLR0911 - one return a case
    """What to say of the robot; what is not known for certain is shown as unknown."""
    if state.terminal:
        return Banner("ended", "standing", "end", "The run has ended.", "It drives no robot any more.")
    if snapshot.doing in ("unknown", "ended"):
        return _silent(snapshot, now_utc_s, driven=driven)
    if snapshot.doing == "starting":
        text = f"It has moved nothing yet, and asks before it does. {NOT_THE_STOP}"
        return Banner("starting", "standing", "open", "The program that drives the robot is starting.", text)
    if snapshot.robot_silent_s > STALE_S and snapshot.robot != "not_connected":
        return _not_heard_of(snapshot)
    stop = _STOPS.get(snapshot.robot)
    if stop is not None:
        return stop
    if snapshot.robot == "moving":
        return _moving(state, snapshot)
    if snapshot.robot == "not_connected":
        title = "Paused. The robot is not connected." if state.paused else "Robot not connected."
        now = f" Now: {busy_words(snapshot)}." if busy_words(snapshot) else ""
        text = f"Nothing has needed it so far.{now} Its own pendant can still move it."
        return Banner("not_connected", "paused" if state.paused else "standing", "open", title, text)
    if state.paused:
        if snapshot.doing == "paused":
            return Banner(
                "paused", "paused", "pause", "Paused. The robot stands still.", "It moves only after Resume."
            )
        return Banner("pausing", "paused", "pause", "Pausing…", "The robot may still move. Wait for Paused.")
    if snapshot.doing != "working":
        return Banner("standing", "standing", "standing", "The robot stands still.", NOT_THE_STOP)
    text = f"{_busy(snapshot)}It may move at any moment."
    return Banner("standing", "standing", "standing", "The robot stands still.", text)


def busy_words(snapshot: Snapshot) -> str:
    """What the program is doing, and for how long; "" if it does not take long.

    A call without a description of its own is described by the work it belongs to, so that a hang is visible.
    """
    if snapshot.lasting:
        return f"{snapshot.activity}, for {snapshot.activity_s:.0f} s"
    if snapshot.quiet_s > STALE_S:
        return f"{snapshot.what or 'something that it does not report'}, for {snapshot.quiet_s:.0f} s"
    return ""


def _busy(snapshot: Snapshot) -> str:
    words = busy_words(snapshot)
    if not words:
        return "A step is under way. "
    hangs = " It hears no button before that is done." if snapshot.quiet_s > STALE_S else ""
    return f"Now: {words}.{hangs} "


def _not_heard_of(snapshot: Snapshot) -> Banner:
    text = (
        f"It has not been heard of for {snapshot.robot_silent_s:.0f} s, in which the program that drives it is at: "
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


def _moving(state: RunState, snapshot: Snapshot) -> Banner:
    if state.paused or snapshot.doing in ("pausing", "paused"):
        return Banner("pausing", "paused", "pause", "Pausing…", "The robot still moves. Wait for Paused.")
    speed = "" if snapshot.speed_fraction is None else f" Speed slider {snapshot.speed_fraction:.0%}."
    now = f" Now: {busy_words(snapshot)}." if busy_words(snapshot) else ""
    return Banner(
        "moving", "moving", "moving", "The robot moves.", f"Stay outside of its reach.{speed}{now} {NOT_THE_STOP}"
    )


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
