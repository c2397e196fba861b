"""References of a job's arguments to earlier answers: what they resolve to, and what cannot be resolved."""

from __future__ import annotations

from typing import Any

import pytest

from service.core.errors import IntegrityError
from service.core.jobs import Each, Reference, references_in, resolve
from service.core.records.base import ArtefactRef
from service.core.run.state import JobState

ANSWER = {"spheres": [{"at": [1.0, 2.0]}, {"at": [3.0, 4.0]}], "camera": {"fx": 5}}


def job(name: str, key: str, enqueued: int, ended: int, result: dict[str, Any] | None = None) -> JobState:
    """A finished job with one file."""
    ref = ArtefactRef(sha256=f"file of {name}", kind="k", media_type="m", size_bytes=1, original_name="n")
    return JobState(
        name, "look", 1, enqueued, key, {}, "finished", artefacts=(ref,), result=result or {}, ended_seq=ended
    )


JOBS = {
    one.job: one
    for one in (
        job("a", "capture/0/look/x/0", 3, 9, ANSWER),
        job("b", "capture/0/look/y/0", 4, 7),
        job("c", "capture/1/look/z/0", 5, 8),
        job("d", "control/0/look/w/0", 2, 6),
    )
}


def test_parts_of_answers_stand_in_the_place_of_references_to_them() -> None:
    recorded = {
        "camera": Reference("a", "result/camera").record(),
        "places": Reference("a", "result/spheres/*/at").record(),
        "first": Reference("a", "result/spheres/0/at/1").record(),
        "of": [{"file": Reference("b", "artefacts/0/sha256").record()}, 7],
    }
    assert resolve(recorded, JOBS) == {
        "camera": {"fx": 5},
        "places": [[1.0, 2.0], [3.0, 4.0]],
        "first": 2.0,
        "of": [{"file": "file of b"}, 7],
    }
    assert len(list(references_in(recorded))) == 4


def test_one_reference_stands_for_all_jobs_that_had_finished_by_an_event() -> None:
    each = Each(("control/0/look/", "capture/0/look/"), upto_seq=8, field="artefacts/0/sha256")
    assert resolve(each.record(), JOBS) == ["file of d", "file of b"]
    later = Each(each.jobs, 9, each.field, without=("b",))
    assert resolve(later.record(), JOBS) == ["file of d", "file of a"]


@pytest.mark.parametrize(
    "reference", [Reference("z", "result"), Reference("a", "result/lens"), Reference("a", "result/spheres/7")]
)
def test_what_is_not_there_is_an_error_of_the_record(reference: Reference) -> None:
    with pytest.raises(IntegrityError):
        resolve({"camera": reference.record()}, JOBS)
