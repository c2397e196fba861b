"""Who answers a run's questions: people, an import's list, automation, a simulated technician; and their display."""

from __future__ import annotations

import json
import os
import select
import socket
import termios
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from service.cli.terminal_output import Terminal, bar_of_counts, styled
from service.computations import term
from service.core.errors import ConfigurationError, OrthocaptureError, PersonNeededError
from service.core.gates import demanded_role
from service.core.protocol import Protocol, Step, irreversible_warning
from service.core.records.entered import reason_of
from service.core.records.import_list import FileRole, ImportList, PhotographRole
from service.core.records.run_events import OperatorAction
from service.core.recovery import takes_words
from service.core.run.decide import AskOperator
from service.core.run.state import HandWork, RunState
from service.core.text_files import parse_json
from service.core.words import shown
from service.monitor.reporter import Reporter
from service.monitor.snapshot import Asks, Doing
from service.people.person import PeopleError
from service.people.sessions import Identity, People, identity_for
from service.runner.held_run import AnswerBy
from service.steps.kinds import ct_import, image_import, scan_import

if TYPE_CHECKING:
    from service.cli.terminal_output import Progress

_ASKS_FOR_A_PHOTOGRAPH = ("next: ", "take the photograph now")  # beginnings of messages that ask for a photograph
_LONGEST_ANSWER = 1 << 20  # characters
_PATIENCE_S = 900  # a CT volume or a scan of the whole scene takes minutes on a busy machine


@dataclass
class SimulatedHands:
    """Acts on the simulated world through its control socket; without an address (a real rig) it does nothing."""

    address: str | None  # HOST:PORT
    _done: set[tuple[str, int]] = field(default_factory=set[tuple[str, int]])

    def do(self, step: Step, attempt: int) -> None:
        """Do what a technician does before confirming this step, once for each attempt. Raises as `act` does."""
        wanted = (action.model_dump(exclude_none=True) for action in step.simulated_hands)
        self.act(step.id, attempt, [HandWork.model_validate(action) for action in wanted])

    def act(self, step: str, attempt: int, actions: Sequence[HandWork]) -> None:
        """Do these actions (those of simulators/rig/world_server.py) one after the other; once for each attempt.

        Raises OrthocaptureError if the simulated world does not answer or cannot do one of them.
        """
        if self.address is None or (step, attempt) in self._done:
            return
        for action in actions:
            answer = _ask_world(self.address, {**action.model_dump(mode="json"), "op": "act"})
            if not answer.get("ok"):
                raise OrthocaptureError(
                    f"the simulated technician could not {action.action}: {answer.get('error')}",
                    where=f"step {step}",
                    remedy="Give the step an action that simulators/rig/world_server.py lists",
                )
        self._done.add((step, attempt))

    def read(self, message: str) -> None:
        """Let the technician read a message of the screen."""
        if self.address is not None and message.startswith(_ASKS_FOR_A_PHOTOGRAPH):
            _ask_world(self.address, {"op": "act", "action": "read", "words": message})


def _ask_world(address: str, request: dict[str, Any]) -> dict[str, Any]:
    host, _, port = address.rpartition(":")
    deadline_s = time.monotonic() + _PATIENCE_S
    try:
        with socket.create_connection((host, int(port)), timeout=10) as link:
            link.settimeout(deadline_s - time.monotonic())
            link.sendall(json.dumps(request).encode() + b"\n")
            with link.makefile("r", encoding="utf-8", errors="replace") as answers:
                line = answers.readline(_LONGEST_ANSWER) or '{"ok": false, "error": "no answer"}'
                answer = parse_json(line, name=address, remedy="Start the rig again")
                return answer if isinstance(answer, dict) else {}
    except (OSError, ValueError) as error:
        raise OrthocaptureError(
            f"the simulated technician does not answer: {error}", where=address, remedy="Start the rig again"
        ) from error


_MOST_MENDS = 4  # how often a step's advice is followed automatically before a person must decide
_STUCK_S = 120.0  # for which a run that nobody attends waits for a disk or a database


class Display:
    """A progress bar with the time left, and one line per event, on stderr; stdout is for results."""

    def __init__(self, console: Terminal, reporter: Reporter) -> None:
        self.console = console
        self.reporter = reporter
        self._progress: Progress | None = None
        self._what = ""

    def show(self, what: str, done: int, total: int) -> None:
        """Update the bar; a new `what` starts a new one."""
        self.reporter.show(what, done, total)
        if not self.console.is_terminal:
            return
        if self._progress is None or what != self._what:
            self.clear()
            self._progress = bar_of_counts(self.console)
            self._progress.start()
            self._progress.add_task(shown(what), total=total or None)
            self._what = what
        self._progress.update(self._progress.task_ids[0], completed=done, total=total or None)

    def clear(self) -> None:
        """Remove the bar."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def tell(self, message: str) -> None:
        """Print one line."""
        self.reporter.tell(message)
        self.clear()
        self.console.print(f"  {message}")


@dataclass
class _Operator:
    """The base of all operators."""

    name: str
    protocol: Protocol
    display: Display
    hands: SimulatedHands

    def show(self, what: str, done: int, total: int) -> None:
        """Show progress."""
        self.display.show(what, done, total)

    def tell(self, message: str) -> None:
        """Print one line."""
        self.display.tell(message)

    def busy(self, what: str) -> None:
        """Report to the screens what a long call is doing."""
        self.display.reporter.busy(what)

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        """Report the run's state to the screens, the signal tower, and alerts to people elsewhere."""
        asks, words = _elsewhere(self.protocol, state, asked) if asked is not None else ("", "")
        attempt = state.step.attempt
        self.display.reporter.attend(doing, state.current, attempt, pedal_armed=pedal_armed, asks=asks, words=words)

    def stuck(self, why: str, for_s: float) -> None:
        """Let the person who was asked put it right, however long that takes."""

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        """Return the items that a confirmation ticks: the whole list, as the terminal says."""
        return question.checklist

    def close(self) -> None:
        """Clean up: the run has ended, or this process is about to."""

    def prepare(self, step: str, attempt: int) -> None:
        """Let the simulated technician, if there is one, do what was confirmed."""
        self.hands.do(self.protocol.step(step), attempt)

    def mend(self, step: str, attempt: int, hands: Sequence[HandWork]) -> None:
        """Let the simulated technician do what the step has asked for."""
        self.hands.act(step, attempt, hands)


@dataclass
class ScreenOperator(_Operator):
    """People at screens, whose answers arrive as events; this process only watches the pedal."""

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | None:
        """Return None always: the web process records what people do."""
        return None

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        """Return the items ticked on a screen: the pedal does no more than the button there."""
        return state.steps[question.step].ticked


@dataclass
class _AcceptanceForm:
    """An acceptance that is being typed: its reason, the hash of its figures, and the name once given."""

    reason: str
    sha256: str
    name: str = ""


@dataclass
class TerminalOperator(_Operator):
    """A person who types; the terminal is polled, so that pedal and web can answer as well."""

    descriptor: int = 0  # file descriptor of the terminal
    preview: Callable[[str], str] = lambda _step: ""  # describes what a step will do; "" if unknown
    people: People | None = None  # accounts of the site, for actions that need a role
    who: Identity | None = None  # the person who types
    _asked: AskOperator | None = None
    _typed: bytes = b""
    _accepting: _AcceptanceForm | None = None

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        """Show a new question once; then return the answer if a line was typed."""
        if question != self._asked:
            self._asked = question
            self._stop_accepting()
            self.print_question(question)
        line = self._line()
        if line is None:
            return None
        if self._accepting is not None:
            return self._accept(self._accepting, line, state)
        verb, _, reason = line.strip().partition(" ")
        action = self._action(question, state, verb, reason.strip())
        if action is not None:
            self._asked = None
        return action

    def _line(self) -> str | None:
        """Return a complete line, or None.

        Not read through sys.stdin, whose buffer would hide further lines from select.
        """
        while b"\n" not in self._typed:
            if not select.select([self.descriptor], [], [], 0)[0]:
                return None
            try:
                read = os.read(self.descriptor, 4096)
            except OSError:  # it hung up
                read = b""
            if not read:
                raise PersonNeededError(
                    "the terminal was closed while a question was open",
                    remedy="Resume the run with `orthocapture resume`; nothing is lost",
                )
            self._typed += read
        line, _, self._typed = self._typed.partition(b"\n")
        return line.decode(errors="replace")

    def print_question(self, question: AskOperator) -> None:
        """Show a question and the possible answers."""
        self.display.clear()
        step = self.protocol.step(question.step)
        lines = [question.text, *(f"  ☐ {item}" for item in question.checklist)]
        plan = self.preview(question.step) if question.for_ == "confirm" else ""
        if plan:
            lines.append(f"\nThe plan: {plan}")
        if step.irreversible and question.for_ in ("confirm", "sign"):
            lines.append(f"\nThis cannot be undone. {irreversible_warning(self.protocol, step)}")
        lines += _ways_lines(question)
        lines.append(f"\nType one of: {', '.join(question.options)} (with a reason where one is needed).")
        if "confirm" in question.options and question.checklist:
            lines.append("By `confirm` you say that every item of the list is done.")
        self.display.console.boxed("\n".join(lines), title=step.title)
        if step.why:
            self.display.console.print(styled(f"Why: {step.why}"), soft_wrap=False)

    def _accept(self, accepting: _AcceptanceForm, line: str, state: RunState) -> AnswerBy | None:
        """Read first the name, then the password, each on its own line; the run is attended to in between."""
        if not accepting.name:
            accepting.name = line.strip() or self.name
            self.display.tell(f"the password of {accepting.name}, then Enter (it is not shown):")
            self._echo(on=False)
            return None
        self._stop_accepting()
        assert self.people is not None  # nobody is asked for a name otherwise
        try:
            who = identity_for(self.people, self.protocol, state, "accept", accepting.name, lambda: line)
        except PeopleError as error:
            self.display.tell(str(error))
            return None
        self._asked = None
        action = OperatorAction(
            action="accept",
            step=state.current,
            reason=accepting.reason,
            signed_sha256=accepting.sha256,
            role=who.role if who else "",
            identified=who.identified if who else "",
        )
        return AnswerBy(action, who.name if who else accepting.name)

    def close(self) -> None:
        """Show typed characters again."""
        self._stop_accepting()

    def _stop_accepting(self) -> None:
        if self._accepting is not None:
            self._accepting = None
            self._echo(on=True)

    def _echo(self, *, on: bool) -> None:
        if os.isatty(self.descriptor):
            mode = termios.tcgetattr(self.descriptor)
            mode[3] = mode[3] | termios.ECHO if on else mode[3] & ~termios.ECHO
            termios.tcsetattr(self.descriptor, termios.TCSADRAIN, mode)

    def _action(self, question: AskOperator, state: RunState, verb: str, reason: str) -> OperatorAction | None:
        if verb not in question.options:
            self.display.tell(f"{verb!r} is not possible now; type one of: {', '.join(question.options)}")
            return None
        try:
            reason = reason and reason_of(reason, ConfigurationError)
        except ConfigurationError as error:
            self.display.tell(str(error))
            return None
        if verb == "accept":
            if not reason:
                self.display.tell("accept needs a reason: type `accept`, a space and the reason")
                return None
            self._accepting = _AcceptanceForm(reason, state.step.gates_sha256)
            self.display.tell(f"who accepts it? The name of the {demanded_role(self.protocol, state)}, then Enter:")
            return None
        target, _, rest = reason.partition(" ")
        names_step = verb == "redo" and target in self.protocol.step_ids
        reason = rest.strip() if names_step else reason
        return OperatorAction.model_validate(
            {
                "action": verb,
                "step": target if names_step else question.step,
                "reason": reason,
                "checklist": question.checklist if verb == "confirm" else (),
                "meaning": (reason or "checked and approved") if verb == "sign" else "",
                "signed_sha256": question.sign_sha256 if verb == "sign" else "",
                "role": self.who.role if self.who else "",
                "identified": self.who.identified if self.who else "",
            }
        )


def _elsewhere(protocol: Protocol, state: RunState, asked: AskOperator) -> tuple[Asks, str]:
    """Return a question in a few words for people elsewhere; what a step asks for in its course is no trouble."""
    title, wanted = protocol.step(asked.step).title, state.step.in_course
    if wanted is not None:
        return "confirm", f"{title}: {wanted.title[:1].lower()}{wanted.title[1:]}"
    due = {"confirm": "a confirmation is awaited", "sign": "a signature is due", "recovery": asked.text}
    return asked.for_, f"{title}: {due[asked.for_]}"


def _ways_lines(question: AskOperator) -> list[str]:
    """Return the choices, the recommended one first, each with what to type, its time and what it loses."""
    lines = ["\nWhat can be done now, the recommended first:"] if question.ways else []
    for way in question.ways:
        if way.available:
            typed = f"redo {way.step}" if way.verb == "redo" else way.verb
            lines.append(f"  {typed}: {way.words}. Takes {takes_words(way.minutes)}. Loses: {way.loses}")
        else:
            lines.append(f"  ({way.words}: not possible, {way.why_not})")
    return lines


@dataclass
class AutomaticOperator(_Operator):
    """Confirms and signs on a simulated rig, and follows a step's advice when its figures are outside limits."""

    _mends: dict[str, int] = field(default_factory=dict[str, int])  # step → how often its advice was followed

    def tell(self, message: str) -> None:
        """Print one line; a simulated person who holds the camera follows its directions."""
        super().tell(message)
        self.hands.read(message)

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction:
        """Confirm the step, recorded as automatic. Raises PersonNeededError if there is no advice left to follow."""
        if question.for_ == "recovery":
            mends = self._mends.get(question.step, 0)
            if state.step.mend and "confirm" in question.options and mends < _MOST_MENDS:
                self._mends[question.step] = mends + 1
                return OperatorAction(action="confirm", step=question.step, via="auto", automatic=True)
            raise PersonNeededError(
                question.text,
                where=f"step {question.step}",
                remedy="Resume the run without --auto-confirm and decide",
            )
        base: dict[str, Any] = {"action": question.for_, "step": question.step, "via": "auto", "automatic": True}
        if question.for_ == "sign":
            return OperatorAction(**base, meaning="automatic, simulated rig", signed_sha256=question.sign_sha256)
        return OperatorAction(**base, checklist=question.checklist)

    def stuck(self, why: str, for_s: float) -> None:
        """Wait for two minutes. Raises PersonNeededError then: nobody attends who could put it right."""
        if for_s > _STUCK_S:
            raise PersonNeededError(
                f"for {for_s:.0f} s the run could not go on: {why}", remedy="Put that right, then resume the run"
            )


def part_of(protocol: Protocol, step_id: str) -> PhotographRole | FileRole | None:
    """Return the part of an import that a step imports; None if it imports nothing."""
    params = protocol.step(step_id).params
    match params:
        case image_import.Params():
            return params.photographs
        case scan_import.Params(device="control_scan"):
            return "control_scan"
        case scan_import.Params(device="scan" | None):
            return "scan"
        case ct_import.Params():
            return "ct"
        case _:
            return None


@dataclass
class ImportOperator(TerminalOperator):
    """The person who gave the command, which confirms the import of everything in the list and nothing else."""

    listing: ImportList | None = None
    _retried: bool = False

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        """Confirm or skip the import of a part; ask at the terminal about anything else.

        Raises PersonNeededError if there is no terminal.
        """
        part = part_of(self.protocol, question.step)
        if question.for_ == "confirm" and part is not None and self.listing is not None:
            if self.listing.holds(part):
                return OperatorAction(action="confirm", step=question.step, checklist=question.checklist)
            if "skip" in question.options:
                return OperatorAction(action="skip", step=question.step, reason=f"no {_words(part)} among the files")
        if question.for_ == "recovery" and "confirm" in question.options and state.sessions > 1 and not self._retried:
            self._retried = True  # giving the command again asks for one retry of what failed
            return OperatorAction(action="confirm", step=question.step)
        if not os.isatty(self.descriptor):
            raise PersonNeededError(
                question.text,
                where=f"step {question.step}",
                remedy="Nothing is lost: give the same command in a terminal and decide, or `orthocapture resume`",
            )
        return super().poll(question, state)


def _words(part: str) -> str:
    return term(part)
