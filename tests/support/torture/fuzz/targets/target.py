"""The definition of a fuzz target: a parser, seed files, their mutations, and the cost limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.core.errors import OrthocaptureError
from tests.support.torture.fuzz.mutations import BYTES, Mutation

LONGEST_LINE = 6_000  # maximum length of an error message


class MisbehavedError(Exception):
    """The parser accepted a bad input, or answered wrongly."""


@dataclass(frozen=True, slots=True)
class Target:
    """One row of the table.

    Attributes:
        name: used on the command line and in the results.
        entry: what is tested, module:function.
        parse: parses one input; gets the bytes and an empty folder of its own. Its exceptions are judged.
        seeds: makes valid inputs with the project's simulators and exporters; gets an empty folder.
        mutations: how a seed is turned into an input.
        errors: the exceptions that the parser may raise.
        says_place: whether its errors must name the file (or address) and a remedy; false only for simulators, whose
            errors have a single text.
        memory_mib: limit for the memory growth of the process.
        seconds: limit for the CPU time of one input; eight times as much in wall time.
        pace: fraction of the usual number of inputs in the short version; below 1 for slow targets.
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
    """Why an exception is a finding; "" if people can act on it."""
    if isinstance(error, MemoryError):
        return "memory: MemoryError"
    if not isinstance(error, target.errors):
        return f"leaks {type(error).__qualname__}"
    wrong = _wrong_words(str(error))
    if not wrong and target.says_place and isinstance(error, OrthocaptureError):
        wrong = "names no place" if not error.where else "names no remedy" if not error.remedy else ""
    return f"words: the message {wrong}" if wrong else ""


def _wrong_words(text: str) -> str:
    try:
        text.encode()
    except UnicodeEncodeError:
        return "cannot be printed"
    if any(ord(c) < 32 and c not in "\n\t" for c in text):
        return "carries control characters"
    return "is too long" if max(map(len, text.split("\n"))) > LONGEST_LINE else ""
