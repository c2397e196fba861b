"""Who answers a run's questions: a person at the terminal, or the automatic stand-in on a simulated rig."""

from __future__ import annotations

import json
import select
import socket
import sys
import time
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from service.core.decide import AskOperator
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.model import OperatorAction
from service.core.protocol import Protocol
from service.core.run_state import RunState


class Display:
    """Progress with the time left, and one line for each thing that happened. On stderr: stdout is for results."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._progress: Progress | None = None
        self._what = ""

    def show(self, what: str, done: int, total: int) -> None:
        """Update the bar; a new `what` starts a new one."""
        if not self.console.is_terminal:
            return
        if self._progress is None or what != self._what:
            self.clear()
            self._progress = Progress(
                TextColumn("  {task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                console=self.console,
                transient=True,
            )
            self._progress.start()
            self._progress.add_task(what, total=total or None)
            self._what = what
        self._progress.update(self._progress.task_ids[0], completed=done, total=total or None)

    def clear(self) -> None:
        """Take the bar away."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def tell(self, message: str) -> None:
        """Print one line."""
        self.clear()
        self.console.print(f"  {message}", highlight=False, markup=False)


@dataclass
class TerminalOperator:
    """A person who types; the terminal is polled so that pedal and web can answer as well."""

    name: str
    protocol: Protocol
    display: Display
    _asked: AskOperator | None = None

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | None:
        """Show a new question once, then look whether a line was typed."""
        if question != self._asked:
            self._asked = question
            self._print(question)
        if not select.select([sys.stdin], [], [], 0)[0]:
            return None
        line = sys.stdin.readline()
        if not line:
            raise ConfigurationError("the terminal was closed while a question was open", remedy="Resume the run")
        verb, _, reason = line.strip().partition(" ")
        self._asked = None
        return self._action(question, verb or "confirm", reason.strip())

    def _print(self, question: AskOperator) -> None:
        self.display.clear()
        step = self.protocol.step(question.step)
        lines = [question.text, *(f"  ☐ {item}" for item in question.checklist)]
        lines.append(f"\nType one of: {', '.join(question.options)} (with a reason where one is needed).")
        self.display.console.print(Panel("\n".join(lines), title=step.title, subtitle=step.why or None))

    def _action(self, question: AskOperator, verb: str, reason: str) -> OperatorAction | None:
        if verb not in question.options:
            self.display.tell(f"{verb!r} is not possible now; one of: {', '.join(question.options)}")
            return None
        return OperatorAction.model_validate(
            {
                "action": verb,
                "step": question.step,
                "reason": reason,
                "checklist": question.checklist if verb == "confirm" else (),
                "meaning": (reason or "checked and released") if verb == "sign" else "",
                "signed_sha256": question.sign_sha256 if verb == "sign" else "",
            }
        )

    def show(self, what: str, done: int, total: int) -> None:
        """Progress."""
        self.display.show(what, done, total)

    def tell(self, message: str) -> None:
        """News."""
        self.display.tell(message)


@dataclass
class AutomaticOperator:
    """Confirms and signs on a simulated rig, after the simulated technician's hands did what the step asks for."""

    name: str
    protocol: Protocol
    display: Display
    hands: str | None  # HOST:PORT of the simulated technician
    _done: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction:
        """Do what a technician would do, then say so; recorded as automatic."""
        if question.for_ == "recovery":
            raise OrthocaptureError(
                question.text,
                where=f"step {question.step}",
                remedy="Resume the run without --auto-confirm and decide",
            )
        base: dict[str, Any] = {"action": question.for_, "step": question.step, "via": "auto", "automatic": True}
        if question.for_ == "sign":
            return OperatorAction(**base, meaning="automatic, simulated rig", signed_sha256=question.sign_sha256)
        self._use_hands(question.step, state.steps[question.step].attempt)
        return OperatorAction(**base, checklist=question.checklist)

    def _use_hands(self, step_id: str, attempt: int) -> None:
        if (step_id, attempt) in self._done or self.hands is None:
            return
        for action in self.protocol.step(step_id).simulated_hands:
            request = {"op": "act", **action.model_dump(exclude_none=True)}
            self.display.show(f"simulated hands: {action.action.replace('_', ' ')}", 0, 0)
            answer = _ask_world(self.hands, request)
            if not answer.get("ok"):
                raise OrthocaptureError(f"the simulated technician could not {action.action}: {answer.get('error')}")
        self._done.add((step_id, attempt))

    def show(self, what: str, done: int, total: int) -> None:
        """Progress."""
        self.display.show(what, done, total)

    def tell(self, message: str) -> None:
        """News."""
        self.display.tell(message)


def _ask_world(address: str, request: dict[str, Any]) -> dict[str, Any]:
    host, _, port = address.rpartition(":")
    deadline_s = time.monotonic() + 300
    try:
        with socket.create_connection((host, int(port)), timeout=10) as link:
            link.settimeout(deadline_s - time.monotonic())
            link.sendall(json.dumps(request).encode() + b"\n")
            with link.makefile("r", encoding="utf-8") as answers:
                return json.loads(answers.readline() or '{"ok": false, "error": "no answer"}')
    except OSError as error:
        raise OrthocaptureError(
            f"the simulated technician does not answer: {error}", where=address, remedy="Start the rig again"
        ) from error
