"""What one target of the sweep is: a parser, real files to begin with, how they are spoilt, and what it may cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.torture.fuzz.mutations import BYTES, Mutation
from service.core.errors import OrthocaptureError

LONGEST_LINE = 6_000  # characters of an error as people read it


class MisbehavedError(Exception):
    """The parser took something for good that is not, or answered as it must not."""


@dataclass(frozen=True, slots=True)
class Target:
    """One row of the table.

    Attributes:
        name: as the command line and the results call it.
        entry: what is tried, module:function.
        parse: reads one input; gets the bytes and an empty folder of its own. What it raises is judged.
        seeds: makes real inputs, as simulators and exporters of this project write them; gets an empty folder.
        mutations: how a seed becomes an input.
        errors: what the parser may raise.
        says_place: whether its errors must name the file (or address) and what to do: everything but simulators,
            whose errors have one text only.
        memory_mib: beyond what the process has before.
        seconds: of processor time for one input; eight times as long on the clock.
        pace: inputs of the short version, in parts of the usual number: less where each takes long.
    """

    name: str
    entry: str
    parse: Callable[[bytes, Path], object]
    seeds: Callable[[Path], Sequence[bytes]]
    mutations: Sequence[Mutation] = BYTES
    errors: tuple[type[Exception], ...] = (OrthocaptureError,)
    says_place: bool = True
    memory_mib: int = 256
    seconds: float = 2.0
    pace: float = 1.0


def fault_of(target: Target, error: BaseException) -> str:
    """Why an exception is a finding, "" for one that people can act upon."""
    if isinstance(error, MemoryError):
        return "memory: MemoryError"
    if not isinstance(error, target.errors):
        return f"leaks {type(error).__qualname__}"
    wrong = _wrong_words(str(error))
    if not wrong and target.says_place and isinstance(error, OrthocaptureError):
        wrong = "names no place" if not error.where else "says not what to do" if not error.remedy else ""
    return f"words: the message {wrong}" if wrong else ""


def _wrong_words(text: str) -> str:
    try:
        text.encode()
    except UnicodeEncodeError:
        return "cannot be printed"
    if any(ord(c) < 32 and c not in "\n\t" for c in text):
        return "carries control characters"
    return "is longer than anybody reads" if max(map(len, text.split("\n"))) > LONGEST_LINE else ""
