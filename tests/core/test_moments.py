"""The time between two moments, which is never negative and never guessed."""

from __future__ import annotations

import pytest

from service.core.records.base import Moment, age_s, elapsed
from service.monitor.snapshot import Snapshot
from service.steps.kinds.timed_application import Result

_EARLIER = Moment(5000.0, "2026-11-21T12:00:00.000000Z", "a")


@pytest.mark.parametrize(
    ("later", "seconds"),
    [
        (Moment(5600.0, "2026-11-21T12:10:00.000000Z", "a"), 600.0),
        (Moment(5600.0, "2026-11-21T12:10:03.000000Z", "a"), 600.0),  # the time service has corrected UTC
        (Moment(5600.0, "2026-11-21T13:10:00.000000Z", "a"), 4200.0),  # slept, or set forward
        (Moment(20.0, "2026-11-21T12:10:00.000000Z", "b"), 600.0),  # restarted
        (Moment(90000.0, "2026-11-21T12:10:00.000000Z", "b"), 600.0),  # restarted long ago
        (Moment(5600.0, "2026-11-21T12:10:00.000000Z", ""), 600.0),  # both clocks agree: no restart
    ],
)
def test_it_is_that_of_the_clock_that_can_tell(later: Moment, seconds: float) -> None:
    assert elapsed(_EARLIER, later).seconds == seconds


@pytest.mark.parametrize(
    ("later", "why"),
    [
        (Moment(5600.0, "2026-11-21T11:10:00.000000Z", "a"), "set back by 3600 s"),
        (Moment(5600.0, "2026-11-21T12:00:00.000000Z", "a"), "set back by 600 s"),
        (Moment(4000.0, "2026-11-21T12:10:00.000000Z", "a"), "ran back by 1000 s"),
        (Moment(20.0, "2026-11-21T11:10:00.000000Z", "b"), "3000 s before"),
        (Moment(20.0, "2026-11-21T12:10:00.000000Z", ""), "not recorded"),
        (Moment(5600.0, "", "a"), "older versions"),
    ],
)
def test_it_is_not_known_where_the_clocks_contradict_each_other(later: Moment, why: str) -> None:
    found = elapsed(_EARLIER, later)
    assert found.seconds is None
    assert why in found.why


def test_a_result_of_an_older_version_is_read_and_its_age_is_not_known() -> None:
    recorded = {"product": "Blue", "applied_monotonic_s": 5000.0, "scan_within_s": 30, "sublimates_after_s": 60}
    old = Result.model_validate(recorded)
    assert elapsed(old.applied, Moment(5600.0, "2026-11-21T12:10:00.000000Z", "a")).seconds is None


def test_a_snapshot_from_before_the_clock_was_set_back_is_stale() -> None:
    snapshot = Snapshot(at_utc_s=10_000.0, doing="working")
    assert not snapshot.stale(10_000.5)
    assert not snapshot.stale(9_999.5)
    assert snapshot.stale(10_000.0 - 3600.0)


@pytest.mark.parametrize(
    ("now_s", "age"),
    [(1060.0, 60.0), (1000.0, 0.0), (996.0, 0.0), (900.0, -1.0)],  # the last: the clock was set back
)
def test_an_age_by_utc_alone_is_never_negative_and_says_when_it_is_not_known(now_s: float, age: float) -> None:
    assert age_s(1000.0, now_s, if_set_back_s=-1.0) == age
