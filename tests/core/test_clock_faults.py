"""The sweep of clock faults knows every place that looks at UTC, and its quick rows are right or on the safe side."""

from __future__ import annotations

import pytest

from tests.support.clocks.places import DURATIONS, PLACES, places
from tests.support.clocks.world import FAULTS, Fault, rows_of

_QUICK = ("age of the coat", "last word of a runner", "age of an unrecorded file", "life of a sign-in")


def test_every_place_that_looks_at_utc_is_covered() -> None:
    assert places() == PLACES.keys()


@pytest.mark.parametrize("fault", FAULTS, ids=[fault.name for fault in FAULTS])
@pytest.mark.parametrize("name", _QUICK)
def test_no_duration_errs_on_the_unsafe_side(name: str, fault: Fault) -> None:
    (duration,) = [one for one in DURATIONS if one.name == name]
    assert [row for row in rows_of(duration, fault) if row.verdict == "WRONG"] == []
