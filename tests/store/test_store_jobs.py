"""Jobs and run leases: once only, one worker at a time, recovered from dead workers, refused to late ones."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from service.core.errors import DataError, StoreError
from service.core.records.run_events import JobFailed, JobFinished, StepNote
from service.store.durable_effects import SystemClock
from service.store.records import LeaseHeldError, LeaseLostError, NewArtefact, NewJob
from service.store.runs import ProcessIdentity, RunLease
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.waiting import until
from tests.support.record.outsider import pass_time
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, enqueue, start_run

ROOT_DIR = Path(__file__).parents[2]
JOB = NewJob("registration", "register", 1, "register-1", {"sigma_px": 0.5, "views": [1, 2]})


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def store(tmp_path: Path, clock: SteppedClock) -> Iterator[Store]:
    with Store.open(tmp_path / "data", clock, CountedIds()) as opened:
        yield opened
        assert verify(tmp_path / "data").ok


def test_enqueueing_twice_gives_the_first_job_and_appends_nothing(store: Store) -> None:
    run = start_run(store)
    first = enqueue(store, run, JOB, actor="runner")
    again = enqueue(store, run, NewJob("registration", "register", 1, "register-1", {"other": 1}), actor="runner")
    assert again == first
    note = StepNote(step="register", attempt=1, note="n")
    events = store.record(run, [note], actor="runner", jobs=[JOB, replace(JOB, idempotency_key="register-2")])
    assert [event.payload.kind for event in events] == ["step_note", "job_enqueued"]
    assert store.events(run)[-2:] == events
    assert [event.payload.kind for event in store.events(run)][:-2] == ["run_started", "job_enqueued"]
    other_run = start_run(store)
    assert enqueue(store, other_run, JOB, actor="runner").job_id != first.job_id


def test_a_job_from_claim_to_finish(store: Store) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    assert store.claim_job("w", 10, kinds=["evaluation"]) is None
    job = store.claim_job("w", 10, kinds=["registration", "evaluation"], run_id=run)
    assert job is not None
    assert (job.state, job.tries, job.worker, job.arguments) == (
        "running",
        1,
        "w",
        {"sigma_px": 0.5, "views": [1, 2]},
    )
    assert store.claim_job("other", 10) is None
    ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name="result.json")
    event = store.finish_job(
        job, measures={"rms_px": 0.4}, duration_s=2.5, artefacts=[NewArtefact(ref, "worker", "register", 1)]
    )
    assert isinstance(event.payload, JobFinished)
    assert event.payload.artefacts == (ref,)
    (done,) = store.jobs(run)
    assert (done.state, done.ended_seq) == ("finished", event.seq)
    with pytest.raises(LeaseLostError, match=r"no longer this worker's \(finished, worker w\)"):
        store.finish_job(job, measures={}, duration_s=1.0)
    with pytest.raises(LeaseLostError, match=r"no longer this worker's \(gone\)"):  # the database is an older copy
        store.finish_job(replace(job, job_id="unknown"), measures={}, duration_s=1.0)
    assert store.claim_job("w", 10) is None


def test_expired_lease_is_reclaimed_and_the_late_worker_refused(store: Store, clock: SteppedClock) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    slow = store.claim_job("slow", 1000)
    assert slow is not None
    pass_time(store, clock, 900)
    slow = store.renew_job(slow, 1000)
    pass_time(store, clock, 900)
    assert store.claim_job("quick", 10) is None
    pass_time(store, clock, 200)
    quick = store.claim_job("quick", 10)
    assert quick is not None
    assert quick.tries == 2
    before = len(store.events(run))
    for late in (
        lambda: store.finish_job(slow, measures={"x": 1.0}, duration_s=1.0),
        lambda: store.fail_job(slow, DataError("late"), retry=True),
        lambda: store.renew_job(slow, 10),
    ):
        with pytest.raises(LeaseLostError):
            late()
    assert len(store.events(run)) == before
    store.finish_job(quick, measures={}, duration_s=1.0)


def test_failure_is_retried_until_the_limit(store: Store) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    for attempt in (1, 2, 3):
        job = store.claim_job("w", 10)
        assert job is not None
        assert job.tries == attempt
        (event,) = store.fail_job(job, DataError("too few markers"), retry=True)
        assert isinstance(event.payload, JobFailed if attempt == 3 else StepNote)
    assert store.claim_job("w", 10) is None
    (failed,) = store.jobs(run)
    assert (failed.state, failed.error) == ("failed", "DataError: too few markers")


def test_hopeless_failure_is_final_at_once(store: Store) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    job = store.claim_job("w", 10)
    assert job is not None
    (event,) = store.fail_job(job, DataError("no mesh"), retry=False)
    assert isinstance(event.payload, JobFailed)
    assert (event.payload.error, event.payload.message) == ("DataError", "no mesh")


def test_a_job_that_kills_its_workers_fails_in_the_end(store: Store, clock: SteppedClock) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    for _try in range(3):
        assert store.claim_job("w", 10) is not None
        pass_time(store, clock, 11)
    assert store.claim_job("w", 10) is None
    last = store.events(run)[-1].payload
    assert isinstance(last, JobFailed)
    assert last.error == "WorkerLost"


CLAIMER = """
import sys
from pathlib import Path
from service.store.store import Store
with Store.open(Path(sys.argv[1])) as store:
    while (job := store.claim_job(sys.argv[2], 60)) is not None:
        store.finish_job(job, measures={}, duration_s=0.0)
        print(job.job_id)
"""


@pytest.mark.slow
def test_racing_workers_do_each_job_once(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
        store.record(run, [], actor="runner", jobs=[NewJob("k", "s", 1, f"key {index}") for index in range(30)])
        workers = [
            subprocess.Popen(
                [sys.executable, "-c", CLAIMER, str(tmp_path), f"w{index}"], cwd=ROOT_DIR, stdout=subprocess.PIPE
            )
            for index in range(3)
        ]
        done = [name for worker in workers for name in worker.communicate(timeout=60)[0].split()]
        assert sorted(done) == sorted(job.job_id.encode() for job in store.jobs(run))
        assert [event.payload.kind for event in store.events(run)].count("job_finished") == 30
    assert verify(tmp_path).ok


def test_one_runner_drives_a_run(store: Store, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch) -> None:
    run = start_run(store)
    note = StepNote(step="s", attempt=1, note="n")
    with monkeypatch.context() as elsewhere:  # on another host only the time is known
        elsewhere.setattr(socket, "gethostname", lambda: "the other computer")
        first = store.lease(run, "runner 1", 1000)
    with pytest.raises(LeaseHeldError, match="runner 1") as refused:
        store.lease(run, "runner 2", 10)
    assert re.search(r"wait (1000|9\d\d) s after it", refused.value.remedy)
    pass_time(store, clock, 900)
    first.renew()
    pass_time(store, clock, 900)
    store.record(run, [note], actor="runner", lease=first)
    pass_time(store, clock, 150)
    with store.lease(run, "runner 2", 10) as second:
        with pytest.raises(LeaseLostError):
            first.renew()
        with pytest.raises(LeaseLostError):
            store.record(run, [note], actor="runner", lease=first)
        first.release()
        store.record(run, [note], actor="runner", lease=second)
    store.lease(run, "runner 3", 10).release()
    assert len(store.events(run)) == 3
    with pytest.raises(StoreError, match="no run"):
        store.lease("nowhere", "r", 10)


@pytest.mark.sqlite("the host's clock judges leases; in PostgreSQL the server's does")
def test_a_runner_on_another_host_keeps_its_run_though_this_clock_was_set_forward(
    store: Store, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = start_run(store)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(socket, "gethostname", lambda: "the other computer")
        first = store.lease(run, "runner 1", 10)
    clock.set_utc(3600.0)

    def renew_by_its_own_clock(_seconds: float) -> None:
        clock.set_utc(-3600.0)
        first.renew()
        clock.set_utc(3600.0)

    clock.passed_s = 3
    clock.on_sleep = renew_by_its_own_clock
    with pytest.raises(LeaseHeldError, match="runner 1"):
        store.lease(run, "runner 2", 10)
    store.record(run, [StepNote(step="s", attempt=1, note="n")], actor="runner", lease=first)
    clock.on_sleep = lambda _seconds: None  # it has died
    store.lease(run, "runner 2", 10).release()


def test_a_runner_that_lives_keeps_its_run_whatever_the_clock_says(store: Store, clock: SteppedClock) -> None:
    run = start_run(store)
    with store.lease(run, "runner 1", 10) as first:
        clock.passed_s = 120  # somebody set it, or the runner waits for long
        assert store.driven(run)
        with pytest.raises(LeaseHeldError, match="runner 1"):
            store.lease(run, "runner 2", 10)
        store.record(run, [StepNote(step="s", attempt=1, note="n")], actor="runner", lease=first)
    assert not store.driven(run)


def test_a_lease_is_renewed_by_itself_also_after_a_store_that_failed(
    store: Store, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = start_run(store)
    renewals: list[float] = []
    really = RunLease.renew

    def renew(lease: RunLease) -> None:
        renewals.append(clock.passed_s)
        if len(renewals) == 1:
            raise StoreError("the disk is full")
        really(lease)

    monkeypatch.setattr(RunLease, "renew", renew)

    def renewed() -> bool:
        clock.sleep(10.0)
        return len(renewals) > 2

    with store.lease(run, "runner", 30.0):
        until(renewed, "the lease is not renewed again", every_s=0.01)
    assert [r.getMessage() for r in caplog.records if run in r.getMessage()] == [
        f"the lease of {run} was not renewed: the disk is full"
    ]


HOLDER = """
import sys, time
from pathlib import Path
from service.store.store import Store
store = Store.open(Path(sys.argv[1]))
store.lease(store.find_run("latest"), "the killed one", 3600)
job = store.claim_job("the killed one", 3600)
print(job.job_id, flush=True)
time.sleep(100)
"""


def test_leases_of_a_killed_process_are_taken_over_at_once(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        run = start_run(store)
        enqueued = enqueue(store, run, JOB, actor="runner")
        with subprocess.Popen(
            [sys.executable, "-c", HOLDER, str(tmp_path)], cwd=ROOT_DIR, stdout=subprocess.PIPE
        ) as holder:
            assert holder.stdout is not None
            assert holder.stdout.readline().decode().strip() == enqueued.job_id
            with pytest.raises(LeaseHeldError, match="the killed one"):
                store.lease(run, "next", 10)
            assert store.claim_job("next", 10) is None
            os.kill(holder.pid, signal.SIGSTOP)  # if continued, it would go on with the arm
            with pytest.raises(LeaseHeldError, match="the killed one"):
                store.lease(run, "next", 10)
            os.kill(holder.pid, signal.SIGKILL)
        with store.lease(run, "next", 10):
            job = store.claim_job("next", 10)
        assert job is not None
        assert (job.job_id, job.tries) == (enqueued.job_id, 2)
        store.finish_job(job, measures={}, duration_s=0.1)
    assert verify(tmp_path).ok


def test_a_process_is_known_by_its_host_its_boot_its_number_and_its_start() -> None:
    """A number is given again, so another start, by more than the second to which it is known, is another process."""
    this = ProcessIdentity.of_this_process()
    assert this.boot
    assert this.life() == "lives"
    for other_start_s in (-1.2, 1.2):
        assert replace(this, process_started_s=this.process_started_s + other_start_s).life() == "lives"
    for other_start_s in (-2.0, 2.0):
        assert replace(this, process_started_s=this.process_started_s + other_start_s).life() == "dead"
    assert replace(this, boot="another").life() == "dead"
    assert replace(this, pid=2**22 + 1).life() == "dead"  # beyond the largest that Linux gives
    assert replace(this, host="another").life() == "unknown"
    assert replace(this, host="another", boot="another").life() == "unknown"


def test_a_host_that_names_no_boot_claims_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name that all boots share would let times of two boots be compared."""
    monkeypatch.setattr("service.store.durable_effects._BOOT_ID", tmp_path / "none")
    assert SystemClock().boot() == ""
