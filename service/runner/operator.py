"""The person in front of a run, as the runner sees them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from typing import Protocol as Interface

from service.core.records.events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.monitor.snapshot import Doing


class AnswerBy(NamedTuple):
    """An answer by somebody else than the person who runs the run: a supervisor at the same terminal."""

    action: OperatorAction
    actor: str


class Operator(Interface):
    """The person in front of the run, or what stands in for one on a simulated rig."""

    name: str

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        """An answer if there is one by now; called about ten times a second while a question is open."""
        ...

    def show(self, what: str, done: int, total: int) -> None:
        """Show the progress of the work under way."""
        ...

    def tell(self, message: str) -> None:
        """Show one line on what happened."""
        ...

    def busy(self, what: str) -> None:
        """Announce a call that takes long, in words; screens show them until the next `attend`."""
        ...

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        """Update what screens show; called several times a second, whatever the runner does."""
        ...

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        """The checklist items that count as done when the foot pedal confirms."""
        ...

    def prepare(self, step: str, attempt: int) -> None:
        """The work of a step is about to begin: a simulated technician does now what was confirmed as done."""
        ...

    def mend(self, step: str, attempt: int, hands: Sequence[Mapping[str, Any]]) -> None:
        """A confirmed retry is about to begin: a simulated technician first does what the step has asked for."""
        ...
