"""Jobs begin when the machine has their memory, end at their time limit, and can be cancelled one at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from service.computations import job_kinds
from service.computations.job import JobAnswer, RecordedContext
from service.computations.kind import Demand
from service.computations.memory_grants import ALONE, Grant, MemoryGrants, waiting_for_memory
from service.core.errors import ComputeError, IllegalTransitionError
from service.core.records.run_events import JobFailed
from service.machine.resources import MachineMemory, machine_memory, processes_for
from service.store.records import LeaseLostError, NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from service.worker import loop
from service.worker.loop import work
from tests.support.record.grants import write_grant
from tests.support.record.stepped_clock import SteppedClock
from tests.support.record.store import CountedIds, enqueue, start_run

LARGE = MachineMemory(total_mb=64_000, available_mb=60_000)
JOB = NewJob("layout", "register", 1, "layout-1", {})


def silent(_what: str, _done: int, _total: int) -> None:
    pass


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def store(tmp_path: Path, clock: SteppedClock) -> Iterator[Store]:
    with Store.open(tmp_path / "data", clock, CountedIds()) as opened:
        yield opened
        assert verify(tmp_path / "data").ok


# --- memory -------------------------------------------------------------------------------------------------------


def group(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="ascii")
    return root


def test_the_limit_of_a_group_or_of_one_above_it_counts_as_the_machines_memory(tmp_path: Path) -> None:
    base = "sys/fs/cgroup/"
    second = group(
        tmp_path / "second",
        {
            "proc/self/cgroup": "0::/site/worker\n",
            f"{base}site/worker/memory.max": "max\n",
            f"{base}site/worker/memory.current": "9\n",
            f"{base}site/worker/memory.stat": "inactive_file 0\n",
            f"{base}site/memory.max": "900000000\n",
            f"{base}site/memory.current": "700000000\n",
            f"{base}site/memory.stat": "anon 5\ninactive_file 300000000\n",
        },
    )
    assert machine_memory(second) == MachineMemory(900, 500)
    first = group(
        tmp_path / "first",
        {
            "proc/self/cgroup": "7:cpu:/x\n4:hugetlb,memory:/docker/abc\n0::/\n",
            f"{base}memory/memory.limit_in_bytes": "800000000\n",
            f"{base}memory/memory.usage_in_bytes": "600000000\n",
            f"{base}memory/memory.stat": "total_inactive_file 100000000\n",
        },
    )
    assert machine_memory(first) == MachineMemory(800, 300)
    free = group(tmp_path / "free", {"proc/self/cgroup": "0::/\n", f"{base}memory.max": "max\n"})
    assert machine_memory(free).total_mb == machine_memory(tmp_path / "none").total_mb


def test_a_job_shares_its_work_among_no_more_processes_than_fit_into_half_of_the_memory() -> None:
    assert processes_for(1, 10, LARGE) == 1
    assert processes_for(500, 10, LARGE) == (os.cpu_count() or 1)
    assert processes_for(500, 1000, MachineMemory(1500, 1000)) == 1


def test_a_job_waits_until_it_fits_beside_those_of_all_workers_and_says_so(store: Store, clock: SteppedClock) -> None:
    data = store.database_path.parent
    free = {"mb": 2000.0}
    grants = MemoryGrants(data, clock, lambda: MachineMemory(8000, free["mb"]))
    folder = data / "monitor" / "memory"
    folder.mkdir(parents=True)
    # Another worker's process: this one's parent, which lives, and a dead one, which does not count.
    theirs = write_grant(folder, os.getppid(), "theirs", 900_000)
    write_grant(folder, 4_000_000, "a dead one's", 50_000)
    told: list[str] = []

    def tell(why: str) -> None:
        told.append(why)
        assert waiting_for_memory(data) == {"mine": why}
        theirs.unlink()  # it has ended its job

    with grants.granted("mine", 1500, tell):
        assert waiting_for_memory(data) == {}
    assert len(told) == 1
    assert "waits for memory: it needs" in told[0]
    assert not list(folder.glob("*.json"))


def test_a_small_job_does_not_overtake_a_large_one_that_has_waited_longer(store: Store, clock: SteppedClock) -> None:
    data = store.database_path.parent
    folder = data / "monitor" / "memory"
    grants = MemoryGrants(data, clock, lambda: MachineMemory(8000, 6000))
    large = write_grant(folder, os.getppid(), "large", 5000, waits="waits for memory", place=1)
    told: list[str] = []

    def tell(why: str) -> None:
        told.append(why)
        assert waiting_for_memory(data) == {"large": "waits for memory", "small": why}
        large.unlink()  # it has begun and ended meanwhile

    with grants.granted("small", 200, tell):
        pass
    assert told == ["waits for memory: one that needs 5000 MB has waited longer"]


def test_a_job_that_waits_for_other_programs_holds_up_no_other(store: Store, clock: SteppedClock) -> None:
    data = store.database_path.parent
    write_grant(data / "monitor" / "memory", os.getppid(), "large", 7500, waits="waits for memory", place=1)
    grants = MemoryGrants(data, clock, lambda: MachineMemory(8000, 2000))  # of no job of ours is the rest
    with grants.granted("small", 200, pytest.fail):
        assert waiting_for_memory(data) == {"large": "waits for memory"}


def test_a_job_for_which_other_programs_leave_no_room_asks_in_the_end(store: Store, clock: SteppedClock) -> None:
    # Terabytes: what the process of these tests has, which counts as used, must not matter.
    data = store.database_path.parent
    grants = MemoryGrants(data, clock, lambda: MachineMemory(8e6, 1e6), patience_s=20)
    told: list[str] = []
    began_s = clock.monotonic_s()
    with (
        pytest.raises(ComputeError, match="has waited 20 s for memory that no computation uses: it waits for"),
        grants.granted("mine", 3e6, told.append),
    ):
        pytest.fail("it has begun")
    assert 20 < clock.monotonic_s() - began_s < 22
    assert len(told) == 1
    assert waiting_for_memory(data) == {}


def test_a_job_waits_for_those_of_other_workers_however_long_they_take(store: Store, clock: SteppedClock) -> None:
    data = store.database_path.parent
    theirs = write_grant(data / "monitor" / "memory", os.getppid(), "theirs", 5e6)
    began_s = clock.monotonic_s()

    def memory() -> MachineMemory:
        if clock.monotonic_s() - began_s < 25:
            return MachineMemory(8e6, 2e6)
        theirs.unlink(missing_ok=True)
        return MachineMemory(8e6, 7e6)

    with MemoryGrants(data, clock, memory, patience_s=20).granted("mine", 3e6, lambda _why: None):
        assert clock.monotonic_s() - began_s >= 25


def test_those_that_wait_keep_the_order_in_which_they_came(store: Store, clock: SteppedClock) -> None:
    data = store.database_path.parent
    folder = data / "monitor" / "memory"
    grants = MemoryGrants(data, clock, lambda: MachineMemory(8000, 6000))
    first = write_grant(folder, os.getppid(), "first", 900_000)  # fills the machine
    places: list[int] = []

    def tell(_why: str) -> None:
        (mine,) = [path for path in folder.glob("*.json") if path != first]
        places.append(Grant.model_validate_json(mine.read_bytes()).place)
        # One that came later waits as well, and is not waited for.
        write_grant(folder, os.getppid(), "later", 300, waits="waits for memory", place=places[-1] + 1)

    with grants.granted("mine", 1500, tell):
        pass
    assert places == [1]


def test_a_job_that_can_never_fit_is_refused_in_words_and_not_tried_again(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")

    def too_large(context: RecordedContext) -> JobAnswer:
        with context.begin(Demand(memory_mb=1e9, limit_s=60)):
            raise AssertionError("it has begun")

    monkeypatch.setitem(loop.HANDLERS, "layout", too_large)
    assert work(store, until_idle=True, stop=lambda: False, progress=silent) == 1
    end = store.events(run)[-1].payload
    assert isinstance(end, JobFailed)
    assert end.error == "ComputeError"
    assert "needs 1000000000 MB of memory, and this machine has" in end.message
    assert "on a machine with more memory" in end.message


def test_jobs_that_are_to_be_alone_wait_for_each_other_and_for_no_other(store: Store, clock: SteppedClock) -> None:
    data = store.database_path.parent
    theirs = write_grant(data / "monitor" / "memory", os.getppid(), "theirs", 100, alone=True)
    grants = MemoryGrants(data, clock, lambda: LARGE)
    with grants.granted("another kind", 100, pytest.fail):
        pass
    reasons: list[str] = []

    def see(why: str) -> None:
        reasons.append(why)
        theirs.unlink()

    with grants.granted("mine", 100, see, alone=True):
        pass
    assert reasons == [ALONE]


def test_a_full_disk_keeps_no_job_from_being_computed(tmp_path: Path, clock: SteppedClock) -> None:
    (tmp_path / "monitor").write_text("no folder", encoding="ascii")
    with MemoryGrants(tmp_path, clock, lambda: LARGE).granted("job", 100, lambda _: None):
        pass


def test_every_kind_states_what_it_demands() -> None:
    from service.computations.kind import usual_demand  # noqa: PLC0415 - only here

    assert [name for name, kind in job_kinds().items() if kind.demand is usual_demand] == []


# --- time limits and cancelling -----------------------------------------------------------------------------------


def test_a_job_that_takes_too_long_is_ended_and_fails_in_words(
    store: Store, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    ended: list[bool] = []

    def for_ever(context: RecordedContext) -> JobAnswer:
        with context.begin(Demand(memory_mb=1, limit_s=600)):
            while not ended:
                clock.sleep(1.0)
        return JobAnswer({"found": 1.0})

    monkeypatch.setitem(loop.HANDLERS, "layout", for_ever)
    work(store, until_idle=True, stop=lambda: False, progress=silent, end=lambda: ended.append(True))
    end = store.events(run)[-1].payload
    assert isinstance(end, JobFailed)
    assert "it was ended after 10 minutes, many times what such a job takes" in end.message
    assert [job.state for job in store.jobs(run)] == ["failed"]


def test_a_person_cancels_one_job_and_touches_no_other(
    store: Store, clock: SteppedClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = start_run(store)
    first = enqueue(store, run, JOB, actor="runner")
    enqueue(store, run, NewJob("layout", "register", 1, "layout-2", {}), actor="runner")
    ended: list[bool] = []

    def cancelled(context: RecordedContext) -> JobAnswer:
        if not ended:
            store.cancel_job(run, first.job_id, actor="Ada", reason="the wrong series")
        while not ended:
            clock.sleep(1.0)
        return JobAnswer({"found": 1.0})

    monkeypatch.setitem(loop.HANDLERS, "layout", cancelled)
    work(store, until_idle=True, stop=lambda: False, progress=silent, end=lambda: ended.append(True))
    assert [job.state for job in store.jobs(run)] == ["failed", "finished"]
    (end,) = [event for event in store.events(run) if isinstance(event.payload, JobFailed)]
    assert end.actor == "Ada"
    assert isinstance(end.payload, JobFailed)
    assert end.payload.error == "JobCancelled"
    assert end.payload.message == "Ada cancelled it: the wrong series"
    with pytest.raises(IllegalTransitionError, match="has failed already"):
        store.cancel_job(run, first.job_id, actor="Ada", reason="again")
    with pytest.raises(IllegalTransitionError, match="has no job 'nothing'"):
        store.cancel_job(run, "nothing", actor="Ada", reason="again")


def test_a_job_in_the_queue_is_cancelled_and_no_worker_gets_it(store: Store) -> None:
    run = start_run(store)
    job = enqueue(store, run, JOB, actor="runner")
    store.cancel_job(run, job.job_id, actor="Ada", reason="not needed")
    assert store.claim_job("w", 10) is None


def test_the_worker_of_a_cancelled_job_cannot_finish_it(store: Store) -> None:
    run = start_run(store)
    enqueue(store, run, JOB, actor="runner")
    job = store.claim_job("w", 10)
    assert job is not None
    assert store.holds_job(job)
    store.cancel_job(run, job.job_id, actor="Ada", reason="not needed")
    assert not store.holds_job(job)
    with ExitStack() as stack:
        stack.enter_context(pytest.raises(LeaseLostError))
        store.finish_job(job, measures={}, duration_s=1.0)
