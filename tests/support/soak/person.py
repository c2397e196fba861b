"""The soak's person types `confirm` at the run's terminal, also after the arm's watchdog has stopped the arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import IO

from service.core.records.run_events import StepFailed
from service.core.run.decide import AskOperator, decide
from service.followed_run import RunRecord

_WATCHDOG = ("LeaveNeededError", "no sign of life")  # error, and words of its message


@dataclass
class Typist:
    """Answers the questions of a run once each.

    Attributes:
        keyboard: standard input of the runner.
        stops: how often the arm's watchdog stopped it.
        puzzled: words of a stop of another kind, which this person does not answer.
    """

    keyboard: IO[bytes]
    stops: int = 0
    puzzled: str = ""
    _answered: int = 0  # number of the last event before the last answer

    def answer(self, run: RunRecord) -> None:
        """Type the answer if a question is open that was not answered yet."""
        question = decide(run.protocol, run.state)
        if not isinstance(question, AskOperator) or run.state.seq == self._answered:
            return
        if question.for_ == "recovery":
            failed = next((e.payload for e in reversed(run.events) if isinstance(e.payload, StepFailed)), None)
            if failed is None or failed.error != _WATCHDOG[0] or _WATCHDOG[1] not in failed.message:
                self.puzzled = question.text
                return
            self.stops += 1
        self._answered = run.state.seq
        self.keyboard.write(b"confirm\n")
        self.keyboard.flush()
