"""The root of the one error tree: every error says what is wrong, where, and what to do."""

from __future__ import annotations

import re
from typing import Any

# What a terminal or a page would obey rather than show, and what cannot be encoded: quoted from files it stays text.
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
_LONGEST, _LONGEST_LINE = 20_000, 4_000  # characters: a file may hold a word of a megabyte


class OrthocaptureError(Exception):
    """Base of all errors of this project.

    Args:
        what: what is wrong, one sentence without a full stop.
        where: file, line, field, device or record that it concerns.
        remedy: what the person should do about it.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what)
        self.what = _shown(what)
        self.where = _shown(where)
        self.remedy = _shown(remedy)

    def __str__(self) -> str:
        place = f" [{self.where}]" if self.where else ""
        advice = f". {self.remedy}" if self.remedy else ""
        return f"{self.what}{place}{advice}"

    def __reduce__(self) -> tuple[Any, ...]:
        # Keyword arguments are lost by the default reduction; errors cross process borders in drivers.host.
        return _rebuild, (type(self), self.what, self.where, self.remedy)


def _shown(text: str) -> str:
    plain = _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)
    return _cut("\n".join(_cut(line, _LONGEST_LINE) for line in plain.split("\n")), _LONGEST)


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest // 2]} … {text[-longest // 4 :]}"


def _rebuild(cls: type[OrthocaptureError], what: str, where: str, remedy: str) -> OrthocaptureError:
    return cls(what, where=where, remedy=remedy)


class ProtocolError(OrthocaptureError):
    """A protocol file is wrong; `where` is file:line and field."""


class ConfigurationError(OrthocaptureError):
    """A rig file or a command's arguments are wrong."""


class IllegalTransitionError(OrthocaptureError):
    """The lifecycle does not allow this action in this state."""


class StoreError(OrthocaptureError):
    """The evidence could not be written or read."""


class IntegrityError(StoreError):
    """Evidence does not verify: a hash, a chain link or a file is wrong."""


class SpaceShortError(StoreError):
    """The disk will soon be full: nothing more is begun, so that what was begun can be recorded."""


class DataError(OrthocaptureError):
    """Input data (image, mesh, DICOM series, pose file) cannot be used."""


class ImagesSpoiltError(OrthocaptureError):
    """Several images in a row are blurred or black: a person looks at the camera before more are taken."""


class ComputeError(OrthocaptureError):
    """A computation has no trustworthy answer on this data, and says why."""
