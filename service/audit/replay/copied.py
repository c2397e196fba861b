"""Jobs of version 1: copies of earlier results in their arguments are recognised and read as references."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from service.core.jobs import Reference
from service.core.run.state import JobState

_TELLING_DIGITS = 12  # a number with so many digits is recognised by its value, since nobody typed it
_TELLING_BITS = (
    32  # what rounding leaves of zero (-7 / 2**55) prints many digits, but two computations often meet in it
)


@dataclass
class CopiedResults:
    """Parts of the answers so far, by their content: an argument that equals a part was copied from there."""

    _parts: dict[str, Reference] = field(default_factory=dict[str, Reference])

    def add(self, job: JobState) -> None:
        """Add the answer of a finished job."""
        self._index(job.job, "result", job.result)

    def _index(self, job: str, path: str, value: Any) -> None:
        if _is_telling(value):
            self._parts[_key(value)] = Reference(job, path)
        if isinstance(value, Mapping):
            for name, item in cast("Mapping[str, Any]", value).items():
                self._index(job, f"{path}/{name}", item)
        elif isinstance(value, list | tuple):
            for index, item in enumerate(cast("Sequence[Any]", value)):
                self._index(job, f"{path}/{index}", item)

    def as_references(self, arguments: Any) -> Any:
        """The arguments with a reference in place of every copy."""
        if _is_telling(arguments):
            found = self._parts.get(_key(arguments))
            if found is not None:
                return found.record()
        if isinstance(arguments, Mapping):
            return {name: self.as_references(item) for name, item in cast("Mapping[str, Any]", arguments).items()}
        if isinstance(arguments, list | tuple):
            return [self.as_references(item) for item in cast("Sequence[Any]", arguments)]
        return arguments


def _key(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def _is_telling(value: Any) -> bool:
    """Whether this holds a number with so many digits that equality means a copy."""
    if isinstance(value, float):
        digits = repr(value).split("e")[0].replace("-", "").replace(".", "").strip("0")
        return len(digits) >= _TELLING_DIGITS and value.as_integer_ratio()[0].bit_length() >= _TELLING_BITS
    if isinstance(value, Mapping):
        return any(map(_is_telling, cast("Mapping[str, Any]", value).values()))
    return isinstance(value, list | tuple) and any(map(_is_telling, cast("Sequence[Any]", value)))
