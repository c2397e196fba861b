"""The foot pedal: one press confirms where nothing moves, two within seconds where the robot will move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import PedalReading
from service.core.run.decide import AskOperator
from service.runner.leave import Pedal

QUESTION = AskOperator("fixation", "confirm", "Go on?", (), ("confirm", "skip"))
OTHER = AskOperator("capture", "confirm", "Move?", (), ("confirm",))
NO_CONFIRM = AskOperator("capture", "recovery", "What now?", (), ("redo", "abort"))


@dataclass
class Box:
    """A light box whose pedal, clocks and faults the test sets."""

    count: int = 7
    now_s: float = 100.0  # of the host
    box_s: float = 40.0  # by which the box's clock is behind
    pressed_s: float | None = 0.0
    fault: DeviceUnavailableError | None = None
    told: list[str] = field(default_factory=list[str])

    def read(self) -> PedalReading | None:
        if self.fault is not None:
            raise self.fault
        return PedalReading(self.count, self.pressed_s, None if self.pressed_s is None else self.now_s - self.box_s)

    def press(self, ago_s: float = 0.0) -> None:
        self.count += 1
        if self.pressed_s is not None:
            self.pressed_s = self.now_s - self.box_s - ago_s


@pytest.fixture
def box() -> Box:
    return Box()


@pytest.fixture
def pedal(box: Box) -> Pedal:
    return Pedal(box.read, lambda: box.now_s, box.told.append)


@pytest.fixture
def look(box: Box, pedal: Pedal) -> Callable[..., bool]:
    def look(question: AskOperator = QUESTION, *, moves: bool = False, after_s: float = 0.1) -> bool:
        """Wait so long, looking as often as a run does, and look; whether any of the looks confirmed."""
        confirmed = False
        while after_s > 0:
            waited_s = min(0.1, after_s)
            after_s = round(after_s - waited_s, 6)
            box.now_s = round(box.now_s + waited_s, 6)
            confirmed |= pedal.confirms(question, moves_robot=moves)
        return confirmed

    return look


def test_one_press_confirms_once_where_nothing_moves(box: Box, look: Callable[..., bool]) -> None:
    assert not look()
    box.press()
    assert look()
    assert not look()


def test_a_press_before_the_question_is_no_answer_to_it(box: Box, look: Callable[..., bool]) -> None:
    assert not look()
    box.press()
    assert not look(OTHER)
    assert not look()  # asked again: its first look only reads the count


def test_a_press_where_confirming_is_no_choice_is_used_up(box: Box, look: Callable[..., bool]) -> None:
    assert not look(NO_CONFIRM)
    box.press()
    assert not look(NO_CONFIRM)
    assert not look(NO_CONFIRM)


@pytest.mark.parametrize(
    ("after_s", "confirmed", "armed"),
    [(0.1, False, True), (0.5, True, False), (2.0, True, False), (6.0, True, False), (6.1, False, True)],
)
def test_the_second_press_counts_within_its_time_only(
    box: Box, pedal: Pedal, look: Callable[..., bool], after_s: float, confirmed: bool, armed: bool
) -> None:
    assert not look(moves=True)
    box.press()
    assert not look(moves=True)
    assert pedal.armed
    assert "press again within 6 s" in box.told[-1]
    if after_s > 0.2:
        assert not look(moves=True, after_s=after_s - 0.2)
    first_s, box.count = box.pressed_s, box.count + 1
    assert first_s is not None
    box.pressed_s = first_s + after_s
    box.now_s = max(box.now_s, box.pressed_s + box.box_s)
    assert look(moves=True) is confirmed
    assert pedal.armed is armed


def test_an_armed_pedal_is_disarmed_by_time_and_by_another_question(
    box: Box, pedal: Pedal, look: Callable[..., bool]
) -> None:
    look(moves=True)
    box.press()
    look(moves=True)
    look(moves=True, after_s=7.0)
    assert not pedal.armed
    box.press()
    look(moves=True)
    assert pedal.armed
    look(OTHER, moves=True)
    assert not pedal.armed


def test_a_hundred_presses_a_second_and_a_box_that_is_late_for_0_7_s_let_nothing_move(
    box: Box, pedal: Pedal, look: Callable[..., bool]
) -> None:
    """They did: the gap was measured between readings, and any larger count was a press."""
    look(moves=True)
    for _ in range(20):
        box.count += 10
        box.pressed_s = box.now_s - box.box_s
        assert not look(moves=True)
    assert not pedal.armed
    box.now_s += 0.7
    box.count += 70
    assert not look(moves=True)
    assert not pedal.armed
    box.press()
    assert not look(moves=True)
    assert pedal.armed  # two presses from now on count
    assert not look(moves=True, after_s=0.4)
    box.press()
    assert look(moves=True, after_s=0.2)


def test_presses_that_the_host_reads_late_are_as_far_apart_as_the_box_says(
    box: Box, pedal: Pedal, look: Callable[..., bool]
) -> None:
    look(moves=True)
    box.press()
    look(moves=True)
    assert not look(moves=True, after_s=0.3)
    box.press(ago_s=0.25)  # 0.15 s after the first: a bounce, whenever it is read
    assert not look(moves=True, after_s=0.3)
    assert pedal.armed


def test_a_press_that_is_read_late_is_a_first_one_at_most(box: Box, pedal: Pedal, look: Callable[..., bool]) -> None:
    look(moves=True)
    box.press()
    look(moves=True)
    assert pedal.armed
    box.now_s += 1.0
    box.press()
    assert not look(moves=True)
    assert pedal.armed
    assert not look(moves=True, after_s=0.6)
    box.press()
    assert look(moves=True)


def test_a_late_reading_disarms(box: Box, pedal: Pedal, look: Callable[..., bool]) -> None:
    look(moves=True)
    box.press()
    look(moves=True)
    box.now_s += 0.7
    assert not look(moves=True)
    assert not pedal.armed
    assert "answered 0.8 s after" in box.told[-1]


def test_a_press_whose_time_cannot_be_true_lets_nothing_move(
    box: Box, pedal: Pedal, look: Callable[..., bool]
) -> None:
    look(moves=True)
    box.press(ago_s=3.0)
    assert not look(moves=True)
    assert not pedal.armed
    box.press(ago_s=-3.0)
    assert not look(moves=True)
    assert not pedal.armed


def test_a_box_whose_clock_jumps_is_not_believed(box: Box, pedal: Pedal, look: Callable[..., bool]) -> None:
    look(moves=True)
    box.press()
    look(moves=True)
    box.box_s -= 2.0
    assert not look(moves=True)
    assert not pedal.armed
    assert "clock jumped" in box.told[-1]


def test_a_box_that_does_not_time_its_presses_lets_nothing_move_and_says_so_once(
    box: Box, pedal: Pedal, look: Callable[..., bool]
) -> None:
    box.pressed_s = None
    look(moves=True)
    for _ in range(3):
        box.press()
        assert not look(moves=True, after_s=1.0)
        assert not pedal.armed
    assert len(box.told) == 1
    assert "before firmware 1.4" in box.told[0]
    assert not look()
    box.press()
    assert look()  # where nothing moves it is as good as any


def test_a_box_that_was_switched_off_counts_from_zero_and_confirms_nothing(
    box: Box, look: Callable[..., bool]
) -> None:
    look()
    box.count = 0
    assert not look()
    box.press()
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
    box.press()  # meanwhile: whoever pressed it may have meant another question
    assert not look()
    box.press()
    assert look()
    box.fault = fault
    assert not look()
    assert len(box.told) == 2
