"""Whoever waits for jobs or events of a site hears of them from the server, and polls while it does not hear."""

from __future__ import annotations

import threading
from contextlib import closing
from pathlib import Path

import pytest

from service.core.records.run_events import StepNote
from service.store.database.database import Channel, HeardChanges, PolledChanges
from service.store.records import NewJob
from service.store.store import Store
from tests.support.processes.postgres import Cluster
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import start_run

pytestmark = [
    pytest.mark.packages("postgresql"),
    pytest.mark.timeout(300),
    pytest.mark.sqlite("listens to a server by itself"),
]
FOR_EVER_S = 1e6


@pytest.mark.parametrize("channel", ["jobs", "chains"])
def test_a_waiter_is_woken_by_what_it_waits_for(cluster: Cluster, tmp_path: Path, channel: Channel) -> None:
    site = cluster.site(tmp_path / "site")
    with Store.open(site) as here, Store.open(site) as there, closing(here.changes(channel)) as changes:
        run_id = start_run(there)
        changes.wait(FOR_EVER_S)  # begins to listen, and lets one look once more
        woken = threading.Thread(target=lambda: changes.wait(FOR_EVER_S), daemon=True)
        woken.start()
        there.record(run_id, [], actor="Ada", jobs=[NewJob("detect", "capture", 1, "a", {})])
        woken.join()
        assert here.claim_job("worker", 60.0) is not None


def test_a_waiter_whose_connection_is_lost_polls_and_listens_again(
    cluster: Cluster, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    database = cluster.new_database()
    site = cluster.site(tmp_path / "site", database)
    with Store.open(site) as store, closing(store.changes("chains")) as changes:
        assert isinstance(changes, HeardChanges)
        run_id = start_run(store)
        changes.wait(FOR_EVER_S)
        listening = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE query LIKE 'LISTEN%'"
        assert cluster.run(database, listening) == [(True,)]
        changes.wait(0.01)
        assert "are not heard but polled for" in caplog.text
        changes.wait(FOR_EVER_S)  # listens again
        store.record(run_id, [StepNote(step="s", attempt=1, note="n")], actor="Ada")
        changes.wait(FOR_EVER_S)


def test_a_folder_of_its_own_and_a_clock_of_a_test_poll(cluster: Cluster, tmp_path: Path) -> None:
    clock = SteppedClock()
    with Store.open(tmp_path / "lite") as store:
        assert isinstance(store.changes("jobs"), PolledChanges)
    with Store.open(cluster.site(tmp_path / "site"), clock) as store, closing(store.changes("jobs")) as changes:
        changes.wait(5.0)
    assert clock.passed_s >= 5.0
