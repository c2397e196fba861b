"""The worker's children: in parallel, replaced when they die, with awaited jobs first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from service.computations.job import JobAnswer, RecordedContext
from service.core.errors import ComputeError, StoreError
from service.core.records.run_events import JobFailed, JobFinished, StepNote
from service.core.run.state import EARLY, LATER, LIVE, WAITED
from service.store.records import Job, NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from service.worker import loop
from service.worker.loop import work
from service.worker.pool import Pool, work_side_by_side
from tests.support.processes import waiting
from tests.support.record import store as records
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import start_run

ROOT_DIR = Path(__file__).parents[2]
CLAIM_AND_DIE = """
import os, sys
from pathlib import Path
from service.store.store import Store
Store.open(Path(sys.argv[1])).claim_job("child", 60.0)
os._exit(9)
"""
LEAVE_A_WORKER = """
import os, subprocess, sys
command = [sys.executable, "-m", "service.cli.main", "worker", "--data", sys.argv[1], "--parent", str(os.getpid())]
print(subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True).pid)
"""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        yield opened
        assert verify(tmp_path / "data").ok


def enqueue(store: Store, run: str, name: str, priority: int = WAITED, kind: str = "layout") -> Job:
    return records.enqueue(store, run, NewJob(kind, "registration", 1, name, {}, priority=priority), actor="runner")


def silent(_what: str, _done: int, _total: int) -> None:
    pass


def until(reached: Callable[[], bool], pool: Pool) -> None:
    for _ in range(600):
        if reached():
            return
        pool.tend(silent, 0.1)
    raise AssertionError("not reached")


def test_what_is_watched_goes_before_what_is_waited_for_and_what_is_not_comes_last(store: Store) -> None:
    run = start_run(store)
    for name, priority in (("later", LATER), ("early", EARLY), ("waited", WAITED), ("live", LIVE), ("live 2", LIVE)):
        enqueue(store, run, name, priority)
    claimed = [store.claim_job("w", 60.0) for _ in range(5)]
    assert [job.idempotency_key for job in claimed if job] == ["live", "live 2", "waited", "early", "later"]


def test_a_lane_takes_its_own_jobs_alone(store: Store) -> None:
    run = start_run(store)
    enqueue(store, run, "early", EARLY)
    assert store.claim_job("w", 60.0, lane="waited") is None
    enqueue(store, run, "waited")
    waited, early = (store.claim_job("w", 60.0, lane=lane) for lane in ("waited", "background"))
    assert waited is not None
    assert early is not None
    assert (waited.idempotency_key, early.idempotency_key) == ("waited", "early")


def test_an_error_that_nobody_foresaw_fails_the_job_with_its_traceback_and_the_worker_goes_on(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(context: RecordedContext) -> JobAnswer:
        raise AttributeError("an attribute that is not there")

    def refused(context: RecordedContext) -> JobAnswer:
        raise ComputeError("too few spheres")

    monkeypatch.setitem(loop.HANDLERS, "layout", broken)
    monkeypatch.setitem(loop.HANDLERS, "hybrid", refused)
    run = start_run(store)
    enqueue(store, run, "one")
    enqueue(store, run, "two", kind="hybrid")
    assert work(store, until_idle=True, stop=lambda: False, progress=silent) == 2
    ends = [e.payload for e in store.events(run) if isinstance(e.payload, JobFailed)]
    assert [end.error for end in ends] == ["AttributeError", "ComputeError"]
    assert "in broken" in ends[0].traceback
    assert ends[1].traceback == ""


@pytest.mark.slow
def test_a_worker_computes_side_by_side_and_ends_when_nothing_is_left(store: Store, tmp_path: Path) -> None:
    run = start_run(store)
    for name in ("a", "b", "c"):
        enqueue(store, run, name, EARLY if name == "c" else WAITED)  # a job without its arguments fails at once
    assert work_side_by_side(tmp_path / "data", at_once=2, until_idle=True, stop=lambda: False, progress=silent) == 3
    ends = [e.payload for e in store.events(run) if isinstance(e.payload, JobFailed)]
    assert [end.error for end in ends] == ["IntegrityError"] * 3


@pytest.mark.slow
def test_a_child_that_is_killed_is_replaced_and_its_job_done_again(store: Store, tmp_path: Path) -> None:
    run = start_run(store)
    with Pool(store, tmp_path / "data", 1) as pool:
        (waited,) = pool.pids()
        os.kill(waited, signal.SIGKILL)
        until(lambda: pool.pids()[0] not in (waited, 0), pool)
        enqueue(store, run, "after")
        until(lambda: store.open_jobs() == 0, pool)
    assert isinstance(store.events(run)[-1].payload, JobFailed)


@pytest.mark.slow
def test_the_job_of_a_killed_child_is_claimed_again_and_given_up_after_some_times(store: Store) -> None:
    run = start_run(store)
    job = enqueue(store, run, "deadly")
    for _ in range(job.try_limit):
        subprocess.run([sys.executable, "-c", CLAIM_AND_DIE, store.database_path.parent], cwd=ROOT_DIR, check=False)
    assert store.claim_job("w", 60.0) is None
    payloads = [event.payload for event in store.events(run)]
    assert sum(isinstance(p, StepNote) and p.note == "job_lease_lost" for p in payloads) == job.try_limit
    end = payloads[-1]
    assert isinstance(end, JobFailed)
    assert end.error == "WorkerLost"


def test_a_worker_that_is_told_to_stop_puts_its_jobs_back_untried(store: Store, tmp_path: Path) -> None:
    run = start_run(store)
    enqueue(store, run, "long")
    held = store.claim_job("w", 60.0)
    assert held is not None
    store.release_jobs([os.getpid()])
    (job,) = store.jobs(run)
    assert (job.state, job.tries) == ("queued", 0)
    again = store.claim_job("w", 60.0)
    assert again is not None
    store.finish_job(again, measures={}, duration_s=0.1)
    assert isinstance(store.events(run)[-1].payload, JobFinished)


def test_a_worker_whose_runner_died_before_it_looked_ends(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data"):
        pass
    answer = subprocess.run(
        [sys.executable, "-c", LEAVE_A_WORKER, str(tmp_path / "data")], stdout=subprocess.PIPE, text=True, check=True
    )
    left = psutil.Process(int(answer.stdout))
    _, alive = psutil.wait_procs([left], timeout=20)
    assert [process for process in alive if process.status() != psutil.STATUS_ZOMBIE] == []


def test_a_lease_is_renewed_although_the_store_failed_for_a_moment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SteppedClock.from_now()
    store = Store.open(tmp_path / "data", clock)
    renew, failures = store.renew_job, iter([StoreError("database is locked")])
    renewed: list[str] = []

    def sometimes(job: Job, lease_s: float) -> None:
        for failure in failures:
            raise failure
        renew(job, lease_s)
        renewed.append(job.job_id)

    def slow(_context: RecordedContext) -> JobAnswer:
        def kept() -> bool:
            clock.sleep(1.0)
            return len(renewed) >= 2

        waiting.until(kept, "the lease is not renewed", every_s=0.01)
        return JobAnswer({})

    monkeypatch.setattr(store, "renew_job", sometimes)
    monkeypatch.setattr(loop, "HANDLERS", {"layout": slow})
    run = start_run(store)
    job = enqueue(store, run, "a")
    work(store, until_idle=True, stop=lambda: False, progress=silent)
    assert renewed == [job.job_id] * 2
    store.close()
