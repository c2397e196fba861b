"""The interface through which the runner sees the person who operates a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from typing import Protocol as Interface

from service.core.records.run_events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import HandWork, RunState
from service.monitor.snapshot import Doing


class AnswerBy(NamedTuple):
    """An answer by another person than the run's operator, such as a supervisor at the same terminal."""

    action: OperatorAction
    actor: str


class Operator(Interface):
    """The person who operates the run, or a stand-in on a simulated rig."""

    name: str

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        """Return the answer, if there is one yet; called about ten times per second while a question is open.

        Raises PersonNeededError where nobody attends who could give it.
        """
        ...

    def show(self, what: str, done: int, total: int) -> None:
        """Show the progress of the work."""
        ...

    def tell(self, message: str) -> None:
        """Show one line on what happened."""
        ...

    def busy(self, what: str) -> None:
        """Say what a long call is about to do; screens show it until the next `attend`."""
        ...

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        """Update what screens show; called several times per second, whatever the runner does."""
        ...

    def stuck(self, why: str, for_s: float) -> None:
        """Called every second while the run cannot go on. Raises PersonNeededError where nobody attends for long."""
        ...

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        """Return the checklist items that count as done when the foot pedal confirms."""
        ...

    def prepare(self, step: str, attempt: int) -> None:
        """Called before a step begins, so that a simulated technician does what was confirmed as done."""
        ...

    def mend(self, step: str, attempt: int, hands: Sequence[HandWork]) -> None:
        """Called before a confirmed retry, so that a simulated technician does what the step has asked for."""
        ...
