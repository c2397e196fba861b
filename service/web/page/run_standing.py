"""How a run stands, told once: every page, banner, list and alert takes its words from here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.core.protocol.models import Protocol
from service.core.run.decide import AskOperator, Decision, decide
from service.core.run.state import RunState, lost_arms
from service.monitor.snapshot import STOPS, RobotPhase, Standing
from service.web.page.run_words import stopped_words

Mode = Literal["ask", "sign", "more", "recover", "work", "paused", "died", "ended"]


@dataclass(frozen=True, slots=True)
class RunStanding:
    """How a run stands now.

    Attributes:
        mode: what it does or waits for.
        decision: what the machine would do next.
        key: the same for a tower, and for screens that are told of other runs.
        word: in one or two words.
        tone: of that word.
        why: what stops it or is asked for, without a full stop; "" for nothing.
        alert: what a screen that looks elsewhere is told; "" while it works.
        headline: what a screen that looks at it is told.
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
    """How a run stands, from its record alone and from who drives it; so a dead runner is noticed too.

    Args:
        protocol: of the run.
        state: of the run.
        driven: whether a running process drives it.
        robot: as its driver last told.
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
    """How a run stands that a process drives, whose robot is not stopped."""
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
