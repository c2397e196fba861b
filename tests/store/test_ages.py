"""The age of a time that is kept in UTC alone, at least and at most, whatever happens to the host's clock."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from service.store.durable_effects import Ages
from tests.support.record.stepped_clock import SteppedClock


@pytest.mark.parametrize(
    ("fault", "least_s", "most_s"),
    [
        (lambda _: None, 600.0, 600.0),
        (lambda clock: clock.set_utc(3600.0), 600.0, 4200.0),  # set forward, or asleep
        (lambda clock: clock.set_utc(-3600.0), -3000.0, 600.0),
    ],
)
def test_one_process_knows_both_bounds(fault: Callable[[SteppedClock], None], least_s: float, most_s: float) -> None:
    clock = SteppedClock()
    ages, since_utc_s = Ages(clock), clock.utc_s()
    ages.begin(since_utc_s)
    fault(clock)
    clock.passed_s += 600.0
    assert ages.at_least_s(since_utc_s) == pytest.approx(least_s)
    assert ages.at_most_s(since_utc_s) == pytest.approx(most_s)


def test_a_new_process_begins_with_utc() -> None:
    clock = SteppedClock()
    since_utc_s = clock.utc_s()
    clock.reboot(600.0)
    ages = Ages(clock)
    clock.passed_s += 60.0
    assert ages.at_most_s(since_utc_s) == pytest.approx(660.0)
    clock.set_utc(-3600.0)
    clock.passed_s += 60.0
    assert ages.at_most_s(since_utc_s) == pytest.approx(720.0)


def test_a_time_to_come_is_negative_until_both_clocks_have_reached_it() -> None:
    clock = SteppedClock()
    ages, due_utc_s = Ages(clock), clock.utc_s() + 30.0
    ages.begin(due_utc_s)
    clock.set_utc(3600.0)
    assert ages.at_least_s(due_utc_s) == pytest.approx(-30.0)
    clock.passed_s += 30.0
    assert ages.at_least_s(due_utc_s) == pytest.approx(0.0)


def test_what_was_met_long_ago_is_forgotten_and_begins_with_utc_again() -> None:
    clock = SteppedClock()
    ages, since_utc_s = Ages(clock), clock.utc_s()
    ages.begin(since_utc_s)
    for number in range(20_000):
        ages.begin(since_utc_s + 1 + number)
    clock.passed_s += 60.0
    assert ages.at_most_s(since_utc_s) == pytest.approx(60.0)
