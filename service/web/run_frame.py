"""The frame of every page of a run: its name and navigation, how it stands, and the texts that pages share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.core.errors import OrthocaptureError, what_of
from service.core.gates import Standing as GateStanding
from service.core.gates import figure, standing, unit_of
from service.core.measure_names import measure_name
from service.core.protocol import Protocol, Step
from service.core.records.import_list import imported_sentence
from service.core.records.run_events import GateVerdict
from service.core.recovery import WayOn, planned_sets, planned_views
from service.core.run.decide import AskOperator, Decision, decide
from service.core.run.expected import tries_words
from service.core.run.state import Mending, RunState, StepState, lost_arms
from service.core.words import time_here
from service.followed_run import RunRecord
from service.monitor.snapshot import STOPS, RobotPhase, Standing, read_snapshot
from service.people.control import Control
from service.steps import step_kinds
from service.steps.coats import Coat, coats
from service.steps.context import ROBOT_MOVES, Announcement, BeforeStep
from service.store.durable_effects import moment_of
from service.web.robot_banner import NOT_THE_STOP, Banner, robot_banner
from service.web.site import Site


def drawing_of(step: Step) -> str:
    """Name of the drawing that shows the step, "" for none: the protocol's own choice, else that of its kind."""
    kind = step_kinds().get(step.kind)
    return step.drawing or (kind.drawing if kind is not None else "")


def limit(minimum: float | None, maximum: float | None, unit: str = "") -> str:
    """Return the limits as text: `at least 0.2 and at most 1 mm`, `exactly 13 spheres`."""
    if minimum is not None and minimum == maximum:
        return f"exactly {minimum:g} {unit_of(minimum, unit)}".rstrip()
    low = "" if minimum is None else f"at least {minimum:g}"
    high = "" if maximum is None else f"at most {maximum:g}"
    last = maximum if maximum is not None else minimum
    unit = unit if last is None else unit_of(last, unit)
    return f"{' and '.join(text for text in (low, high) if text) or 'no limit'} {unit}".rstrip()


def sentence(text: str) -> str:
    """Begin with a capital letter and end with a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def station_of(step: Step) -> str:
    """Return the station of a capture step as `station 1`; "" for other steps."""
    return " and ".join(dict.fromkeys(str(one.station).replace("_", " ") for one in planned_sets(step)))


def count(amount: int, one: str, many: str = "") -> str:
    """Return a number of images as `1 image`, `8 images`."""
    return f"{amount} {one if amount == 1 else many or one + 's'}"


def will_happen(step: Step, now: StepState) -> tuple[str, str]:
    """Return what a confirmation of this step does: the large text of its button, and a line below."""
    kind = step_kinds().get(step.kind)
    left = max(planned_views(step) - len(now.captured), 0)
    before = BeforeStep(step.title, left, station_of(step))
    said = kind.words(step.params, before) if kind is not None and kind.words is not None else None
    if said is None:
        moves = step.moves_robot
        begin = f"begin {step.title[:1].lower()}{step.title[1:]}"
        said = Announcement(begin, ROBOT_MOVES) if moves else Announcement(begin)
    return f"Confirm: {said.does}", said.below


def figure_line(verdict: GateVerdict) -> str:
    """Return one figure of what is signed or did not pass."""
    allowed = limit(verdict.minimum, verdict.maximum, verdict.unit)
    undecided = "; not decided" if verdict.undecided else ""
    return f"{measure_name(verdict.measure)} {figure(verdict)} ({allowed}{undecided})"


def needs(verdict: GateVerdict) -> str:
    """Return what a gate needs: `Coverage 0.896, needs at least 0.9`."""
    allowed = limit(verdict.minimum, verdict.maximum, verdict.unit)
    undecided = ", not decided" if verdict.undecided else ""
    return f"{measure_name(verdict.measure)} {figure(verdict)}, needs {allowed}{undecided}"


def stopped_words(protocol: Protocol, state: RunState, question: AskOperator) -> str:
    """Say why a run is stopped and what is recommended: `Coverage 0.896, needs at least 0.9 → take these 6 views`."""
    now = state.step
    failed = [needs(verdict) for verdict in now.verdicts if not verdict.passed]
    if now.failure is not None:
        why = sentence(what_of(now.failure.message)).rstrip(".")  # the place and the remedy stand below
    else:
        why = "; ".join(failed) or sentence(question.text).rstrip(".")
    way = next((way for way in question.ways if way.available), None)
    return f"{why} → {way_words(state, way)}" if way is not None else why


def way_words(state: RunState, way: WayOn) -> str:
    """Describe a way on in few words, with a small letter: mending views are counted, an advice is cut at its end."""
    mends = state.step.mend or Mending()
    views = len(mends.viewpoints)
    if way.verb == "confirm" and views:
        return f"take {'this view' if views == 1 else f'these {views} views'}"
    boards = len(mends.poses)
    if way.verb == "confirm" and boards:
        return f"take {boards} more {'image' if boards == 1 else 'images'} of the board"
    words = way.words.split(";")[0].split(". ")[0].rstrip(".")
    return words[:1].lower() + words[1:]


_STANDINGS: dict[GateStanding, tuple[str, str]] = {
    "within": ("Within", "ok"),
    "not_decided": ("Not decided", "attention"),
    "accepted": ("Accepted", "attention"),
    "outside": ("Outside", "stop"),
}


def gate_word(verdict: GateVerdict, *, accepted: bool = False) -> tuple[str, str]:
    """Return a gate's outcome as a word and its tone. `accepted`: a person accepted figures outside the limits."""
    return _STANDINGS[standing(verdict, accepted=accepted)]


def phase_words(state: RunState, step: StepState, *, stopped: bool = False) -> tuple[str, str, str]:
    """Return a step's status in the list of steps: word, tone, icon. `stopped`: the current one needs a decision."""
    if step.skipped:
        return "skipped", "skipped", "skip"
    if step.phase == "passed" and step.accepted is not None:
        return "accepted outside its limits", "skipped", "attention"
    if step.phase == "passed":
        return "passed", "passed", "ok"
    if step.step == state.current and not state.terminal:
        return ("stopped", "stopped", "fail") if stopped else ("now", "current", "now")
    if state.terminal and step.step == state.current:
        return "stopped here", "current", "fail"
    return "to come", "pending", "open"


Mode = Literal["ask", "sign", "more", "recover", "work", "paused", "died", "ended"]


@dataclass(frozen=True, slots=True)
class RunStanding:
    """The present standing of a run.

    Attributes:
        mode: the thing that it does or waits for.
        decision: the decision of what the machine would do next.
        key: the standing for a signal tower, and for screens that show other runs.
        word: the standing in one or two words.
        tone: the tone of that word.
        why: the thing that stops it or is asked for, without a full stop; "" for nothing.
        alert: the message for a screen that looks elsewhere; "" while it works.
        headline: the message for a screen that looks at it.
    """

    mode: Mode
    decision: Decision
    key: Standing
    word: str
    tone: str
    why: str
    alert: str
    headline: str


def run_standing(
    protocol: Protocol, state: RunState, *, driven: bool, robot: RobotPhase = "not_connected"
) -> RunStanding:
    """Return how a run stands, from its record alone and from who drives it; so a dead runner is noticed too.

    Args:
        protocol: the run's protocol.
        state: the run's state.
        driven: true if a running process drives it.
        robot: the robot's phase, as its driver last reported it.
    """
    decision, title = decide(protocol, state), protocol.step(state.current).title
    if state.terminal:
        told = f"The run is {state.status}."
        tone = "ok" if state.status == "completed" else "attention"
        return RunStanding("ended", decision, "ended", state.status.capitalize(), tone, "", told, told)
    if not driven:
        why = "the program that drives it does not run → open it and go on"
        told = "The program that drives the robot does not run."
        headline = "The program that drives the robot has stopped. Everything captured is safe."
        return RunStanding("died", decision, "stopped", "Stopped", "stop", why, told, headline)
    found = _driven(protocol, state, decision, title)
    if robot in STOPS:
        why = f"the robot reports: {robot.replace('_', ' ')}"
    elif lost_arms(state):
        why = "the connection to the robot was lost, and nobody has looked at it since"
    else:
        return found
    told = f"{why[:1].upper()}{why[1:]}."
    return RunStanding(found.mode, decision, "stopped", "Stopped", "stop", why, told, found.headline)


def _driven(protocol: Protocol, state: RunState, decision: Decision, title: str) -> RunStanding:
    """Return how a run stands that a process drives, whose robot is not stopped."""
    if state.paused:
        told = "The run is paused."
        return RunStanding("paused", decision, "waits", "Paused", "attention", "", told, f"Paused at: {title}.")
    if not isinstance(decision, AskOperator):
        return RunStanding("work", decision, "works", "Under way", "now", "", "", f"Working: {title}.")
    wanted = state.step.in_course
    if wanted is not None:
        word, why = "Waits for a confirmation", wanted.title
        told, headline = f"{title}: {why[:1].lower()}{why[1:]}.", f"{title}: {why}."
        return RunStanding("more", decision, "waits", word, "attention", why, told, headline)
    if decision.for_ == "recovery":
        why = stopped_words(protocol, state, decision)
        told, headline = f"{title}: {why}.", f"{title}. Stopped: {why}."
        return RunStanding("recover", decision, "stopped", "Stopped", "stop", why, told, headline)
    if decision.for_ == "sign":
        due = "a signature is due"
        word, headline = "Waits for a signature", f"{title}: {due}."
        return RunStanding("sign", decision, "waits", word, "attention", "", f"{title}: {due}.", headline)
    due, word = "your confirmation is awaited", "Waits for a confirmation"
    headline = f"Now: {title}. {due[:1].upper()}{due[1:]}."
    return RunStanding("ask", decision, "waits", word, "attention", "", f"{title}: {due}.", headline)


@dataclass(frozen=True, slots=True)
class Attention:
    """The report of a screen by sound and notification, if alerts are switched on there."""

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
    """The data about a run that base.html.j2 needs."""

    run_id: str
    name: str
    protocol_id: str
    protocol_version: str
    protocol_sha256: str
    simulated: bool
    imported: str  # the sentence that says so; "" for a run that captures its photographs itself
    live: bool  # not ended, so there may be new events
    pausable: bool
    asked: tuple[str, str]  # the screen that has control, and the name of who asks for it; "" for nobody
    attention: Attention
    banner: Banner
    tabs: tuple[Tab, ...]
    coats: tuple[Coat, ...] = ()  # coats that disappear before a scan which is still to come


def run_frame(site: Site, run_id: str) -> RunFrame:
    """Return the frame of a run's pages. Raises UnknownRunError."""
    log = site.run(run_id)
    root = log.root
    here = f"/runs/{run_id}"
    now_utc_s = site.store.clock.utc_s()
    holder = Control(site.store).holder(run_id)
    driven, snapshot = site.launcher.driven(run_id), read_snapshot(site.data, run_id, now_utc_s)
    stands = run_standing(log.protocol, log.state, driven=driven, robot=snapshot.robot)
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
        asked=(holder.screen, holder.asked_by_name),
        attention=Attention(stands.key, stands.alert),
        banner=robot_banner(
            log.state,
            snapshot,
            now_utc_s,
            driven=driven,
            tries=tries_words(log.protocol, log.state, time_here),
            moves=log.protocol.step(log.state.current).moves_robot,
        ),
        tabs=(
            Tab(here, "Step"),
            Tab(f"{here}/capture", "Capture"),
            Tab(f"{here}/scene", "3D view"),
            Tab(f"{here}/calibration", "Calibration"),
            Tab(f"{here}/dataset", "Data set"),
            Tab(f"/audit/runs/{run_id}", "Audit", below=True),
        ),
        coats=coats_of(site, log),
    )


def coats_of(site: Site, log: RunRecord) -> tuple[Coat, ...]:
    """Return the coats of a run whose clocks run now."""
    return coats(log.protocol, log.state, moment_of(site.store.clock))


def driven_frames(site: Site, *, but: str = "") -> list[RunFrame]:
    """Return the frames of all runs that a living process drives now, for the banners of pages that are not theirs.

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
        run_id, run_id, "", "", "", simulated=False, imported="", live=False, pausable=False, asked=("", ""),
        attention=Attention(), banner=banner, tabs=(),
    )  # fmt: skip
