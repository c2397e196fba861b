"""The cost of queries grows at most linearly with the size of a run: counted in executed lines, not seconds."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from service.core.records.run_events import StepNote
from service.followed_run import RunFollower, read_log
from service.run_start import recorded_run
from service.steps.context import Evidence
from service.store.verification.verify import show
from service.web.capture_view import views_of
from tests.support.record.counting import lines_of
from tests.support.soak.large_record import STEP, LargeRecord

SMALL, LARGE = 40, 80
MOST = 2.3  # limit of the ratio for twice as many viewpoints


@contextmanager
def record_of(folder: Path, viewpoints: int) -> Generator[LargeRecord]:
    record = LargeRecord(folder, viewpoints, 2000)
    try:
        record.grow(viewpoints)
        yield record
    finally:
        record.close()


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[LargeRecord, LargeRecord]]:
    with ExitStack() as stack:
        folder = tmp_path_factory.mktemp("linear")
        small, large = (stack.enter_context(record_of(folder / str(n), n)) for n in (SMALL, LARGE))
        yield small, large


def audit_show(record: LargeRecord) -> Callable[[], object]:
    return lambda: show(record.folder / "data", record.run_id)


def capture_page(record: LargeRecord) -> Callable[[], object]:
    log = read_log(record.store, record.run_id, recorded_run(record.store, record.run_id)[0])
    return lambda: views_of(log, log.protocol.step(STEP))


def held_already(record: LargeRecord) -> Callable[[], object]:
    log = RunFollower(record.store, record.run_id, recorded_run(record.store, record.run_id)[0])
    lease = record.store.lease(record.run_id, "test", 60)
    evidence = Evidence(log, lease, STEP, 1, lambda: None, lambda *_: None, lambda _s: None, lambda: None)
    last = record.store.artefacts(record.run_id)[-1].ref.sha256
    assert evidence.holds(last)
    assert not evidence.holds("0" * 64)
    lease.release()
    return lambda: evidence.holds(last)


@pytest.mark.slow
@pytest.mark.parametrize("asked", [audit_show, pytest.param(capture_page, marks=pytest.mark.sweep)])
def test_twice_as_many_viewpoints_are_twice_the_work(
    records: tuple[LargeRecord, LargeRecord], asked: Callable[[LargeRecord], Callable[[], object]]
) -> None:
    small, large = (lines_of(asked(record), "/service/") for record in records)
    assert small > SMALL, "nothing was counted"
    assert large < MOST * small


@pytest.mark.slow
def test_a_page_that_follows_a_run_does_not_plan_it_anew(records: tuple[LargeRecord, LargeRecord]) -> None:
    _, record = records
    capture_page(record)()
    record.store.record(record.run_id, [StepNote(step=STEP, attempt=1, note="seen")], actor="runner")
    assert lines_of(capture_page(record), "/service/core/geometry.py") == 0


@pytest.mark.slow
def test_whether_a_photograph_is_there_already_is_asked_without_reading_them_all(
    records: tuple[LargeRecord, LargeRecord],
) -> None:
    small, large = (lines_of(held_already(record), "/service/") for record in records)
    assert large == small
