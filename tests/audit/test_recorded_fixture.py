"""A run recorded by an earlier version opens, verifies and replays with the current one."""

from __future__ import annotations

import shutil
import tarfile
from pathlib import Path

import pytest

from service.audit.filters import EventFilter
from service.audit.queries import events_page
from service.audit.recorded_run import read_run
from service.audit.replay import replay
from service.core.records.run_events import JobEnqueued, StepMeasured
from service.steps.protocol_check import measures_of
from service.store.store import Store
from service.store.verification.verify import verify

RECORDED = Path(__file__).parents[1] / "data" / "recorded"

pytestmark = [pytest.mark.timeout(300), pytest.mark.sqlite("a record of an earlier version, in SQLite")]


def quiet(_what: str, _done: int, _total: int) -> None:
    """Ignore the progress."""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of 2026-11-23, whose jobs hold copies of earlier results."""
    folder = tmp_path_factory.mktemp("recorded")
    with tarfile.open(RECORDED / "2026-11-23.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder / "data"


def test_it_opens_and_its_events_add_up(data: Path) -> None:
    run = read_run(data, "latest")
    assert run.state.status == "completed"
    kinds = {event.payload.job_kind for event in run.events if isinstance(event.payload, JobEnqueued)}
    assert {"calibrate", "live_view", "live_summary", "locate_spheres", "register", "evaluate"} <= kinds
    assert run.summary().best() == "robot_corrected"


def test_every_measure_that_it_recorded_is_declared_by_the_kind_of_its_step(data: Path) -> None:
    run = read_run(data, "latest")
    steps = {step.id: step for step in run.protocol.steps}
    measured = [event.payload for event in run.events if isinstance(event.payload, StepMeasured)]
    assert measured
    for payload in measured:
        declared = measures_of(steps[payload.step], steps)
        assert declared is not None
        assert set(payload.measures) <= set(declared), payload.step


def test_it_verifies(data: Path) -> None:
    report = verify(data)
    assert report.first_fault is None
    assert report.ok


@pytest.mark.slow
def test_its_computations_give_the_same_again(data: Path) -> None:
    kinds = ("locate_spheres", "live_summary", "evaluate")  # others take minutes
    report = replay(read_run(data, "latest"), kinds=kinds, end_to_end=True, progress=quiet)
    assert report.verdict in ("identical", "within_tolerance")
    assert {job.kind for job in report.jobs} == set(kinds)
    assert not any(gate.changed for gate in report.gates)


def test_reading_leaves_the_older_database_as_it_was(data: Path) -> None:
    database = data / "orthocapture.sqlite"
    before = database.read_bytes()
    assert verify(data).ok
    assert read_run(data, "latest").state.status == "completed"
    assert database.read_bytes() == before


def test_it_is_upgraded_when_it_is_opened_for_writing(data: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(data, tmp_path / "data"))
    with Store.open(folder) as store:
        run_id = store.find_run("latest")
        with store.database.reading() as connection:
            for words, found in (("register", True), ("Registér", True), ("no-such-word", False)):
                page = events_page(connection, run_id, EventFilter(q=words))
                assert bool(page.rows) is found, words
    report = verify(folder)
    assert report.ok, report.faults
