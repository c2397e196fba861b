"""The loops of nonlinear least squares: Gauss–Newton, plain or with halved steps, and Levenberg–Marquardt.

The problems differ in their weights and in what they eliminate, but share the loop.
Source: Nocedal and Wright, Numerical Optimization, 10.3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from service.core.geometry import Array

StateT = TypeVar("StateT")


def largest(step: Array) -> float:
    """Return the largest absolute coordinate of a step."""
    return float(np.abs(step).max())


def gauss_newton(
    start: StateT,
    step_at: Callable[[StateT], Array],
    moved: Callable[[StateT, Array], StateT],
    *,
    most: int,
    settled: float,
    size: Callable[[StateT, Array], float] = lambda _state, step: largest(step),
) -> StateT:
    """Take Gauss–Newton steps until one is smaller than `settled`, or `most` are done, and return the state.

    Args:
        start: initial state, near the minimum.
        step_at: the step (n,) that minimises the problem linearised at a state.
        moved: the state after a step.
        most: largest number of steps.
        settled: size of a step at convergence, in the unit of `size`.
        size: norm of a step from a state; its largest coordinate by default.
    """
    state = start
    for _ in range(most):
        step = step_at(state)
        before, state = state, moved(state, step)
        if size(before, step) < settled:
            break
    return state


@dataclass(frozen=True, slots=True)
class Damping:
    """Damping schedule of Levenberg–Marquardt."""

    first: float
    down: float = 10.0  # divisor after an accepted step
    up: float = 10.0  # factor after a rejected step
    least: float = 0.0
    most: float = 1e6  # above it, no step helps


_HALVING = Damping(1.0, down=math.inf, up=2.0, least=1.0, most=1024.0)  # of the divisor of a step


@dataclass(frozen=True, slots=True)
class Descent(Generic[StateT]):
    """Result of a descent.

    Attributes:
        state: the best state found.
        steps: number of steps tried.
        settled: true if a step settled, before the steps ran out or none helped any more.
        stuck: true if the damping exceeded its limit, because no step helped any more.
    """

    state: StateT
    steps: int
    settled: bool
    stuck: bool


def levenberg_marquardt(
    start: StateT,
    candidate_of: Callable[[StateT, float], StateT],
    gain_of: Callable[[StateT, StateT], float],
    settles: Callable[[StateT, StateT], bool],
    *,
    damping: Damping,
    most: int,
    renewed: Callable[[StateT], StateT] | None = None,
) -> Descent[StateT]:
    """Take damped steps until one settles; a step is accepted unless it increases the cost.

    Args:
        start: initial state, with its linearisation and cost.
        candidate_of: the linearised state after a step from a state with a given damping.
        gain_of: decrease of the cost from a state to a candidate; minus infinity if it is not a number.
        settles: says if the step from a state to a candidate, accepted or not, is the last.
        damping: its schedule.
        most: largest number of steps tried.
        renewed: updates an accepted state's weights or other parts of its cost; None: nothing is updated.
    """
    state, value = start, damping.first
    for step in range(1, most + 1):
        candidate = candidate_of(state, value)
        taken, last = gain_of(state, candidate) >= 0, settles(state, candidate)
        if taken:
            state, value = candidate, max(value / damping.down, damping.least)
        if last:
            return Descent(state, step, settled=True, stuck=False)
        if taken:
            state = state if renewed is None else renewed(state)
        else:
            value *= damping.up
            if value > damping.most:
                return Descent(state, step, settled=False, stuck=True)
    return Descent(state, most, settled=False, stuck=False)


def halved_gauss_newton(
    start: StateT,
    candidate_of: Callable[[StateT, float], StateT],
    gain_of: Callable[[StateT, StateT], float],
    settles: Callable[[StateT, StateT], bool],
    *,
    most: int,
) -> Descent[StateT]:
    """Take Gauss–Newton steps, each halved, down to a thousandth, as long as it would increase the cost.

    It is `levenberg_marquardt` with the step's divisor in place of the damping. Where some unknowns are eliminated
    with a covariance of their own, damping would not shorten all in proportion.

    Args:
        start: initial state, with its cost and its Gauss–Newton step.
        candidate_of: the same after a share (0 … 1] of a state's step.
        gain_of: decrease of the cost from a state to a candidate; minus infinity if it is not a number.
        settles: says if the step from a state to a candidate, accepted or not, is the last.
        most: largest number of steps tried.
    """
    return levenberg_marquardt(
        start, lambda here, divisor: candidate_of(here, 1 / divisor), gain_of, settles, damping=_HALVING, most=most
    )
