"""The root of the one error tree: every error says what is wrong, where, and what to do."""

from __future__ import annotations

from typing import Any

from service.core.words import shown_lines

_LONGEST, _LONGEST_LINE = 20_000, 4_000  # characters: a quoted file may hold a megabyte without a space


class OrthocaptureError(Exception):
    """Base of all errors of this project.

    Args:
        what: the fault in one sentence without a full stop.
        where: the file, line, field, device or record concerned.
        remedy: the advice to the reader.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what)
        self.what = printable(what)
        self.where = printable(where)
        self.remedy = printable(remedy)

    def __str__(self) -> str:
        place = f" [{self.where}]" if self.where else ""
        advice = f". {self.remedy}" if self.remedy else ""
        return f"{self.what}{place}{advice}"

    def __reduce__(self) -> tuple[Any, ...]:
        # Default pickling loses keyword arguments, and drivers.host sends errors between processes.
        return _rebuild, (type(self), self.what, self.where, self.remedy)


def what_of(text: str) -> str:
    """Return the fault from the recorded text of an error, without the place and the remedy."""
    return text.split(" [", maxsplit=1)[0].split(". ", maxsplit=1)[0].rstrip(".")


def printable(text: str) -> str:
    """Return a text to print and record: not too long, and with escapes for what a terminal would obey."""
    return _cut("\n".join(_cut(line, _LONGEST_LINE) for line in shown_lines(text).split("\n")), _LONGEST)


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest // 2]} … {text[-longest // 4 :]}"


def _rebuild(cls: type[OrthocaptureError], what: str, where: str, remedy: str) -> OrthocaptureError:
    return cls(what, where=where, remedy=remedy)


class ProtocolError(OrthocaptureError):
    """A protocol file is wrong; `where` names file:line and field."""


class ConfigurationError(OrthocaptureError):
    """A rig file or a command's arguments are wrong."""


class IllegalTransitionError(OrthocaptureError):
    """The lifecycle does not allow this action in this state."""


class PersonNeededError(OrthocaptureError):
    """The run waits for a decision that only a person can make, and nobody attends; it can be resumed."""


class StoreError(OrthocaptureError):
    """The evidence could not be written or read."""


class IntegrityError(StoreError):
    """Evidence does not verify: a hash, a link of the chain or a file is wrong."""


class SpaceShortError(StoreError):
    """The disk is nearly full: no new work begins, so that work in progress can still be recorded."""


class DataError(OrthocaptureError):
    """Input data (image, mesh, DICOM series, pose file) cannot be used."""


class ImagesSpoiltError(OrthocaptureError):
    """Several images in a row are blurred or black: a person must check the camera before more are taken."""


class ComputeError(OrthocaptureError):
    """A computation has no trustworthy answer for this data; the message says why."""


class UnforeseenError(OrthocaptureError):
    """A step ended with an error that nobody foresaw, such as one of a library; the log has where it was raised."""
