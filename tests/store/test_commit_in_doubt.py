"""A connection that is lost at the very moment of a commit: no event is lost, and none is recorded twice."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from service.core.errors import StoreError
from service.core.records.run_events import StepNote
from service.store.records import NewArtefact, NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.cut_connections import Cut, CutConnections, cut_connections
from tests.support.processes.postgres import Cluster
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, captured, put_image, start_run

pytestmark = [
    pytest.mark.packages("postgresql"),
    pytest.mark.timeout(300),
    pytest.mark.sqlite("begins a server by itself"),
]
KINDS = ["run_started", "viewpoint_captured", "job_enqueued"]


@pytest.fixture
def between(cluster: Cluster, tmp_path: Path) -> Generator[CutConnections]:
    """Cuts connections of the site tmp_path/site."""
    site = cluster.site(tmp_path / "site") / "site.yaml"
    with cut_connections(cluster.folder) as made:
        site.write_text(site.read_text().replace(str(cluster.folder), str(made.folder)))
        yield made


def record_view(store: Store, run: str) -> None:
    """Record one viewpoint with its file and a job, in one transaction."""
    ref = put_image(store, "v1")
    store.record(
        run,
        [captured(ref, "v1")],
        actor="camera",
        artefacts=[NewArtefact(ref, "camera")],
        jobs=[NewJob("registration", "register", 1, "key")],
    )


def kinds(store: Store, run: str) -> list[str]:
    return [event.payload.kind for event in store.events(run)]


def test_what_the_server_has_committed_is_not_recorded_again(between: CutConnections, tmp_path: Path) -> None:
    with Store.open(tmp_path / "site", SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        between.cut = "after it was done"
        record_view(store, run)
        assert between.seen == 1
        assert kinds(store, run) == KINDS
        assert len(store.artefacts(run)) == 3
        store.record(run, [StepNote(step="s", attempt=1, note="goes on")], actor="Ada")
    report = verify(tmp_path / "site")
    assert (report.ok, report.events) == (True, 4), report.faults


def test_what_never_reached_the_server_is_said_and_can_be_repeated(between: CutConnections, tmp_path: Path) -> None:
    with Store.open(tmp_path / "site", SteppedClock(), CountedIds()) as store:
        run = start_run(store)
        between.cut = "before it arrives"
        with pytest.raises(StoreError, match="the connection to the database was lost, and nothing of this was"):
            record_view(store, run)
        assert between.seen == 1
        assert kinds(store, run) == KINDS[:1]
        record_view(store, run)
        assert kinds(store, run) == KINDS
    report = verify(tmp_path / "site")
    assert (report.ok, report.events) == (True, 3), report.faults


@pytest.mark.parametrize(("cut", "found"), [("before it arrives", KINDS[:1]), ("after it was done", KINDS)])
def test_a_server_that_stays_away_leaves_an_open_question(
    between: CutConnections, tmp_path: Path, cut: Cut, found: list[str]
) -> None:
    with Store.open(tmp_path / "site", SteppedClock(), CountedIds(), patience_s=0.1) as store:
        run = start_run(store)
        between.cut, between.away = cut, True
        with pytest.raises(StoreError, match=r"whether this was recorded is not known.*look at the end of the run"):
            record_view(store, run)
        between.away = False
        assert kinds(store, run) == found
    report = verify(tmp_path / "site")
    assert (report.ok, report.events) == (True, len(found)), report.faults
