"""The operator of an import: confirms parts that are in the list, skips parts that are not, asks for the rest."""

from __future__ import annotations

import os
from dataclasses import dataclass

from service.cli.run.terminal.operators import TerminalOperator
from service.core.errors import PersonNeededError
from service.core.protocol.models import Protocol
from service.core.records.events import OperatorAction
from service.core.records.import_list import FileRole, ImportList, PhotographRole
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.jobs.words import term
from service.runner.operator import AnswerBy
from service.steps.kinds import ct_import, image_import, scan_import


def part_of(protocol: Protocol, step_id: str) -> PhotographRole | FileRole | None:
    """The part of an import that a step imports; None if it imports nothing."""
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
