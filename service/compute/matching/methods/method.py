"""The declaration of a method of feature matching. It is given two pictures and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array
from service.core.loading import declared_kinds, kind_named

GROUP = "orthocapture.matchers"
Picture = NDArray[np.uint8]  # (H, W, 3), blue first


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pixels (M, 2) of matches in both pictures, the first pixel's centre at 0, and the method's confidence (M,)."""

    first_px: Array = field(repr=False)
    second_px: Array = field(repr=False)
    confidence: Array = field(repr=False)


class Match(Interface):
    """A method that is ready to run."""

    def __call__(self, first: Picture, second: Picture) -> Matches:
        """Match two pictures."""
        ...


@dataclass(frozen=True, slots=True)
class Matcher:
    """A matching method.

    Attributes:
        name: its name on the command line.
        words: its label in the table.
        load: makes it ready, with its weights if it has any. Raises ConfigurationError, which says what to install,
            if something is missing, and DataError if the weights are not its own.
        weights: description of its file of weights; "" if it has none.
    """

    name: str
    words: str
    load: Callable[[Path | None], Match]
    weights: str = ""


def matchers() -> dict[str, Matcher]:
    """Return every method by its name.

    Raises:
        ConfigurationError: two have the same name, or an entry point names something else.
    """
    return declared_kinds("service.compute.matching.methods", GROUP, Matcher)


def matcher(name: str) -> Matcher:
    """Return the method of this name.

    Raises:
        ConfigurationError: there is none.
    """
    return kind_named(name, matchers(), what="matching method", option="--method")
