"""The loops of nonlinear least squares: Gauss–Newton, and Levenberg–Marquardt with its damping.

The problems differ in what they weigh and eliminate, not in the loop. Source: Nocedal and Wright, Numerical
Optimization, 10.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from service.core.geometry import Array

StateT = TypeVar("StateT")


def largest(step: Array) -> float:
    """The largest coordinate of a step, without its sign."""
    return float(np.abs(step).max())


def gauss_newton(
    start: StateT,
    step_at: Callable[[StateT], Array],
    moved: Callable[[StateT, Array], StateT],
    *,
    most: int,
    settled: float,
    size: Callable[[Array], float] = largest,
) -> StateT:
    """The state after at most `most` steps; none follows one whose size is below `settled`.

    Args:
        start: where to begin, near the minimum.
        step_at: the step (n,) that minimises the problem linearised at a state.
        moved: the state after a step.
        most: number of steps.
        settled: in the unit of `size`.
        size: of a step.
    """
    state = start
    for _ in range(most):
        step = step_at(state)
        state = moved(state, step)
        if size(step) < settled:
            break
    return state


@dataclass(frozen=True, slots=True)
class Damping:
    """How the damping of Levenberg–Marquardt changes."""

    first: float
    down: float = 10.0  # divides it after a step that was taken
    up: float = 10.0  # multiplies it after one that was not
    least: float = 0.0
    most: float = 1e6  # beyond, no step helps


@dataclass(frozen=True, slots=True)
class Descent(Generic[StateT]):
    """Where a descent ended.

    Attributes:
        state: the best one.
        steps: tried.
        stuck: the damping went beyond its limit: no step helped any more.
    """

    state: StateT
    steps: int
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
    """Damped steps until one settles; a step is taken where it gains something, or loses nothing.

    Args:
        start: a state with its linearisation and cost.
        candidate_of: the state, linearised, after the step from a state with a damping.
        gain_of: by how much a candidate's cost is below that of the state; minus infinity where it is no number.
        settles: whether the step from a state to a candidate, taken or not, is the last.
        damping: its course.
        most: number of steps tried.
        renewed: a state that was reached, with what its cost depends on chosen anew; None: nothing is.
    """
    state, value = start, damping.first
    for step in range(1, most + 1):
        candidate = candidate_of(state, value)
        taken, last = gain_of(state, candidate) >= 0, settles(state, candidate)
        if taken:
            state, value = candidate, max(value / damping.down, damping.least)
        if last:
            return Descent(state, step, stuck=False)
        if taken:
            state = state if renewed is None else renewed(state)
        else:
            value *= damping.up
            if value > damping.most:
                return Descent(state, step, stuck=True)
    return Descent(state, most, stuck=False)
