"""The worker beside a run: when it is killed, it is replaced and the run is told."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from service.cli.run import worker_beside
from service.core.records.run_events import JobFailed
from service.store.records import NewJob
from service.store.store import Store
from tests.support.processes.below import processes_below
from tests.support.processes.waiting import until
from tests.support.record.store import enqueue, start_run


def worker_of(data: Path) -> psutil.Process:
    (found,) = processes_below(lambda line: str(data) in line, recursive=False)
    return found


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced_and_the_run_gets_its_answer(tmp_path: Path) -> None:
    told: list[str] = []
    with Store.open(tmp_path) as store:
        run = start_run(store)
        with worker_beside(tmp_path, told.append):
            worker = worker_of(tmp_path)
            worker.kill()
            job = NewJob("locate_spheres", "capture", 1, "key", {"mesh": "0" * 64, "radius_m": 0.015, "expected": 10})
            enqueue(store, run, job, actor="runner")
            until(lambda: any(isinstance(event.payload, JobFailed) for event in store.events(run)), lambda: str(told))
            another = worker_of(tmp_path)
        assert another.pid != worker.pid
        assert not another.is_running()
    assert told == ["the worker process has ended (status -9); another one is started"]
