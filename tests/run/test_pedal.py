"""The foot pedal: one press confirms where nothing moves, two within seconds where the robot will move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from drivers.errors import DeviceUnavailableError
from service.core.run.decide import AskOperator
from service.runner.pedal import Pedal

QUESTION = AskOperator("fixation", "confirm", "Go on?", (), ("confirm", "skip"))
OTHER = AskOperator("capture", "confirm", "Move?", (), ("confirm",))
NO_CONFIRM = AskOperator("capture", "recovery", "What now?", (), ("redo", "abort"))


@dataclass
class Box:
    """A light box whose pedal, clock and faults the test sets."""

    count: int = 7
    now_s: float = 100.0
    fault: DeviceUnavailableError | None = None
    told: list[str] = field(default_factory=list[str])

    def presses(self) -> int:
        if self.fault is not None:
            raise self.fault
        return self.count


@pytest.fixture
def box() -> Box:
    return Box()


@pytest.fixture
def pedal(box: Box) -> Pedal:
    return Pedal(box.presses, lambda: box.now_s, box.told.append)


@pytest.fixture
def look(pedal: Pedal) -> Callable[..., bool]:
    def look(question: AskOperator = QUESTION, *, moves: bool = False) -> bool:
        return pedal.confirms(question, moves_robot=moves)

    return look


def test_one_press_confirms_once_where_nothing_moves(box: Box, look: Callable[..., bool]) -> None:
    assert not look()
    box.count += 1
    assert look()
    assert not look()


def test_a_press_before_the_question_is_no_answer_to_it(box: Box, look: Callable[..., bool]) -> None:
    assert not look()
    box.count += 1
    assert not look(OTHER)
    assert not look()  # asked again: its first look only reads the count


def test_a_press_where_confirming_is_no_choice_is_used_up(box: Box, look: Callable[..., bool]) -> None:
    assert not look(NO_CONFIRM)
    box.count += 1
    assert not look(NO_CONFIRM)
    assert not look(NO_CONFIRM)


@pytest.mark.parametrize(
    ("after_s", "confirmed", "armed"),
    [(0.1, False, True), (0.5, True, False), (2.0, True, False), (6.0, True, False), (6.1, False, True)],
)
def test_the_second_press_counts_within_its_time_only(
    box: Box, pedal: Pedal, look: Callable[..., bool], after_s: float, confirmed: bool, armed: bool
) -> None:
    box.now_s = 0.0  # so that the differences are exact
    assert not look(moves=True)
    box.count += 1
    assert not look(moves=True)
    assert pedal.armed
    assert "press again within 6 s" in box.told[-1]
    box.now_s += after_s
    box.count += 1
    assert look(moves=True) is confirmed
    assert pedal.armed is armed


def test_an_armed_pedal_is_disarmed_by_time_and_by_another_question(
    box: Box, pedal: Pedal, look: Callable[..., bool]
) -> None:
    look(moves=True)
    box.count += 1
    look(moves=True)
    box.now_s += 7.0
    look(moves=True)
    assert not pedal.armed
    box.count += 1
    look(moves=True)
    assert pedal.armed
    look(OTHER, moves=True)
    assert not pedal.armed


def test_a_box_that_was_switched_off_counts_from_zero_and_confirms_nothing(
    box: Box, look: Callable[..., bool]
) -> None:
    look()
    box.count = 0
    assert not look()
    box.count = 1
    assert look()


def test_a_broken_pedal_is_told_once_until_it_works_again(box: Box, look: Callable[..., bool]) -> None:
    look()
    box.fault = DeviceUnavailableError("no answer", where="lightbox")
    assert not look()
    assert not look()
    assert len(box.told) == 1
    assert "the foot pedal does not work" in box.told[0]
    box.now_s += 30.0
    assert not look()
    assert len(box.told) == 1  # repeated, it would push the other messages off the screen
    box.fault, fault = None, box.fault
    box.now_s += 30.0
    box.count += 1
    assert look()
    box.fault = fault
    assert not look()
    assert len(box.told) == 2
