"""Copies of earlier results are recognised by numbers that nobody typed and rounding did not leave."""

from __future__ import annotations

import pytest

from service.audit.replay import CopiedResults
from service.core.run.state import JobState


@pytest.fixture
def earlier() -> CopiedResults:
    copied = CopiedResults()
    copied.add(
        JobState(
            job="job-1",
            kind="register",
            attempt=1,
            enqueued_seq=1,
            idempotency_key="register",
            arguments={},
            result={"rotation": [0.9780451426714946, -7 / 2**55, 0.5], "typed": 0.015},
        )
    )
    return copied


def test_a_number_with_all_its_digits_is_a_copy(earlier: CopiedResults) -> None:
    read = earlier.as_references({"value": 0.9780451426714946})
    assert read == {"value": {"$from": {"job": "job-1", "field": "result/rotation/0"}}}


@pytest.mark.parametrize("value", [-7 / 2**55, 0.5, 0.015, 0.0])
def test_what_rounding_leaves_of_zero_and_what_a_person_types_are_no_copies(
    earlier: CopiedResults, value: float
) -> None:
    assert earlier.as_references({"value": value}) == {"value": value}
