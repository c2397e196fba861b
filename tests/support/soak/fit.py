"""Fits to measurements: growth rates with confidence intervals, and the order of growth of durations."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BLOCKS = 12


class Duration(NamedTuple):
    """A duration: wall time, and CPU time of this process, which other load does not lengthen."""

    wall_s: float
    cpu_s: float

    @classmethod
    def now(cls) -> Duration:
        """The current clock readings."""
        return cls(time.perf_counter(), time.process_time())

    def since(self, earlier: Duration) -> Duration:
        """The difference to earlier readings."""
        return Duration(self.wall_s - earlier.wall_s, self.cpu_s - earlier.cpu_s)


@dataclass(frozen=True, slots=True)
class Growth:
    """The slope of a line with the half-width of its 95 % interval, in units of y per unit of x."""

    slope: float
    half_width: float

    @property
    def least(self) -> float:
        """The lower bound of the growth, with 97.5 % confidence."""
        return self.slope - self.half_width


def growth(x: Sequence[float], y: Sequence[float]) -> Growth | None:
    """Fit a line to y over x; None for fewer than four distinct x.

    Successive samples are correlated, so they are averaged in at most BLOCKS blocks; otherwise the interval would be
    too narrow.
    """
    blocks = [part for part in np.array_split(np.arange(len(x)), min(BLOCKS, len(x))) if len(part)]
    at = [float(np.mean(np.asarray(x)[part])) for part in blocks]
    mean = [float(np.mean(np.asarray(y)[part])) for part in blocks]
    if len(set(at)) < 4:
        return None
    if len(set(mean)) == 1:
        return Growth(0.0, 0.0)
    from scipy.stats import linregress, t  # noqa: PLC0415 - half a second in every worker of the tests

    line = linregress(at, mean)
    return Growth(float(line.slope), float(line.stderr * t.ppf(0.975, len(at) - 2)))


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """The exponent p in seconds ∝ sizes**p, by least squares of the logarithms; 1 means linear."""
    shortest = 1e-6  # resolution of the clock
    logarithms = [math.log(max(taken, shortest)) for taken in seconds]
    return float(np.polyfit(np.log(sizes), logarithms, 1)[0])
