"""The exit statuses of all commands: one table, and the one place that decides which an error has."""

from __future__ import annotations

from enum import IntEnum

from service.core.errors import OrthocaptureError, PersonNeededError


class ExitStatus(IntEnum):
    """How a command ended."""

    DONE = 0
    FAILED = 1
    NOT_POSSIBLE = 2
    WAITS_FOR_A_PERSON = 75  # EX_TEMPFAIL of sysexits.h


#: What each means, for the command line's page of the documents.
MEANINGS: dict[ExitStatus, str] = {
    ExitStatus.DONE: "done, and whatever was checked is as it should be",
    ExitStatus.FAILED: "refused or failed; or done, and something differs, is outside its limits or not completed",
    ExitStatus.NOT_POSSIBLE: "wrong usage: unknown command, option or value; for `replay` also a run that cannot be "
    "replayed",
    ExitStatus.WAITS_FOR_A_PERSON: "the run waits for a decision of a person, and the command had nobody to ask; the "
    "run stays open",
}


def exit_status(error: OrthocaptureError) -> ExitStatus:
    """Return the status of a command that ends with this error."""
    return ExitStatus.WAITS_FOR_A_PERSON if isinstance(error, PersonNeededError) else ExitStatus.FAILED
