"""The loops of least squares: where they end, what they take, and when they give up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from service.compute.descent import Damping, gauss_newton, halved_gauss_newton, levenberg_marquardt
from service.core.geometry import Array


@dataclass(frozen=True)
class Valley:
    """Rosenbrock's valley as residuals: its minimum lies at (1, 1)."""

    x: Array

    @property
    def residual(self) -> Array:
        return np.array([10 * (self.x[1] - self.x[0] ** 2), 1 - self.x[0]])

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    def after(self, damping: float) -> Valley:
        J = np.array([[-20 * self.x[0], 10.0], [-1.0, 0.0]])
        return Valley(self.x - np.linalg.solve(J.T @ J + damping * np.eye(2), J.T @ self.residual))


def gain(here: Valley, there: Valley) -> float:
    return here.cost - there.cost if math.isfinite(there.cost) else -math.inf


def test_damped_steps_follow_the_valley_and_never_climb() -> None:
    costs: list[float] = []

    def settles(here: Valley, there: Valley) -> bool:
        if gain(here, there) >= 0:
            costs.append(there.cost)
        return there.cost < 1e-20

    found = levenberg_marquardt(
        Valley(np.array([-1.2, 1.0])), Valley.after, gain, settles, damping=Damping(1e-2), most=200
    )
    assert not found.stuck
    assert found.state.x == pytest.approx([1.0, 1.0], abs=1e-9)
    assert costs == sorted(costs, reverse=True)
    assert found.steps < 100


def test_a_descent_that_nothing_helps_ends_where_it_was() -> None:
    start = Valley(np.array([0.5, 0.5]))
    worse = Valley(np.array([9.0, -9.0]))
    found = levenberg_marquardt(
        start, lambda _here, _damping: worse, gain, lambda _here, _there: False, damping=Damping(1.0, up=10), most=50
    )
    assert found.stuck
    assert found.state is start
    assert found.steps == 7, "the damping grows from 1 beyond a million"


def test_what_the_cost_depends_on_is_chosen_anew_after_a_step_that_was_taken() -> None:
    renewed: list[float] = []

    def again(here: Valley) -> Valley:
        renewed.append(here.cost)
        return here

    levenberg_marquardt(
        Valley(np.array([-1.2, 1.0])), Valley.after, gain, lambda _here, there: there.cost < 1e-20,
        damping=Damping(1e-2), most=200, renewed=again,
    )  # fmt: skip
    assert len(renewed) > 3
    assert renewed == sorted(renewed, reverse=True)


def test_gauss_newton_stops_after_the_first_small_step_or_the_last_one() -> None:
    steps: list[float] = []

    def root_of_two(x: float) -> Array:
        steps.append((2 - x * x) / (2 * x))
        return np.array([steps[-1]])

    found = gauss_newton(1.0, root_of_two, lambda x, step: x + float(step[0]), most=20, settled=1e-6)
    assert found == pytest.approx(math.sqrt(2), abs=1e-12)
    assert [abs(step) < 1e-6 for step in steps] == [False] * (len(steps) - 1) + [True]
    steps.clear()
    gauss_newton(1.0, root_of_two, lambda x, step: x + float(step[0]), most=2, settled=0.0)
    assert len(steps) == 2


@dataclass(frozen=True)
class Arc:
    """The residual arctan(x): from beyond 1.4, whole Gauss–Newton steps move ever farther from its zero."""

    x: float

    @property
    def cost(self) -> float:
        return math.atan(self.x) ** 2

    def after(self, share: float) -> Arc:
        return Arc(self.x - share * math.atan(self.x) * (1 + self.x**2))


def test_a_step_that_overshoots_is_halved_and_the_next_one_is_tried_whole() -> None:
    shares: list[float] = []

    def after(here: Arc, share: float) -> Arc:
        shares.append(share)
        return here.after(share)

    found = halved_gauss_newton(
        Arc(3.0), after, lambda here, there: here.cost - there.cost, lambda _here, there: there.cost < 1e-24, most=20
    )
    assert found.settled
    assert abs(found.state.x) < 1e-12
    assert shares[:4] == [1.0, 0.5, 0.25, 1.0]


def test_a_descent_tells_whether_it_settled_or_the_steps_ran_out() -> None:
    found = halved_gauss_newton(
        Arc(1.0), Arc.after, lambda here, there: here.cost - there.cost, lambda _here, _there: False, most=2
    )
    assert not found.settled
    assert not found.stuck
    assert found.steps == 2
    start = Arc(1.0)
    found = halved_gauss_newton(start, lambda _here, _share: Arc(9.0), lambda _here, _there: -1.0,
                                lambda _here, _there: False, most=50)  # fmt: skip
    assert found.stuck
    assert found.state is start
    assert found.steps == 11, "a share of a thousandth is the last that is tried"
