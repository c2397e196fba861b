"""The benchmark of a recorded run as a job of its site: it is enqueued, waited for, and its answer is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.benchmark.methods import Method, missing
from service.benchmark.recorded import WantedBenchmark, benchmark_job, write_answer
from service.cli.common import console, error_console
from service.cli.ending import stop_requested
from service.computations.benchmark import KIND, BenchmarkResult
from service.core.errors import ComputeError, IntegrityError
from service.core.records.run_events import JobFailed, JobFinished
from service.core.words import counted, time_here
from service.dataset.summary import summarise
from service.monitor.snapshot import living_workers
from service.run_start import recorded_run
from service.store.data_folder import object_store_of
from service.store.records import Job
from service.store.signatures.signing import checkpoint_here
from service.store.store import Store

Progress = Callable[[str, int, int], None]
_LOOK_S = 1.0
_ARRIVES_S = 300.0  # within which files of an answer must have been uploaded


@dataclass(frozen=True, slots=True)
class AskedBenchmark:
    """A benchmark that stands in the queue of a site; `added` is false if it stood there before."""

    store: Store
    job: Job
    method: Method
    added: bool


def ask_for_benchmark(
    store: Store, run_id: str, method: Method, wanted: WantedBenchmark, *, actor: str
) -> AskedBenchmark:
    """Enqueue the benchmark of a completed run, unless the same waits or is computed already, and sign that.

    Raises:
        IllegalTransitionError: the run is not complete or not released.
        DataError: the run has no evaluated registration.
    """
    new = benchmark_job(summarise(store, run_id, recorded_run(store, run_id)[0]), wanted)
    added = bool(store.record(run_id, [], actor=actor, jobs=[new]))
    if added and not store.driven(run_id):
        checkpoint_here(store, run_id)
    job = store.job_with_key(run_id, new.idempotency_key)
    assert job is not None  # it was enqueued, now or before
    return AskedBenchmark(store, job, method, added)


def wait_for_benchmark(asked: AskedBenchmark, progress: Progress, *, quiet: bool) -> JobFinished | None:
    """Wait for the answer of a benchmark, and show how it stands; None if Ctrl-C leaves the job to its worker.

    Raises:
        ComputeError: the job has failed, or was cancelled; the message says why.
    """
    shown = ""
    with stop_requested() as leave:
        while (now := _now(asked)).state in ("queued", "running"):
            standing = _standing(asked, now)
            progress(standing, 0, 0)
            if not quiet and standing != shown:
                error_console.print(f"  {standing}")
                shown = standing
            if leave.wait(_LOOK_S):
                return None
    (end,) = (e.payload for e in asked.store.events(now.run_id, (now.ended_seq or 1) - 1)[:1])
    if isinstance(end, JobFailed):
        raise ComputeError(end.message, where=f"job {now.job_id} of run {now.run_id}")
    assert isinstance(end, JobFinished)
    return end


def written_answer(asked: AskedBenchmark, answered: JobFinished, out: Path, progress: Progress) -> BenchmarkResult:
    """Write the answer into the folder of results, and return it.

    Where a site has an object store, its files arrive there after the answer: they are waited for.

    Raises:
        IntegrityError: a file does not arrive, or is altered.
    """
    store, run_id = asked.store, asked.job.run_id
    run = summarise(store, run_id, recorded_run(store, run_id)[0])
    arrives = object_store_of(store.database_path.parent) is not None
    until_s = store.clock.monotonic_s() + (_ARRIVES_S if arrives else 0.0)
    while True:
        try:
            return write_answer(run, answered, out)
        except IntegrityError:
            if store.clock.monotonic_s() >= until_s:
                raise
            progress(f"waits for the files of the answer, which {answered.worker} uploads", 0, 0)
            store.clock.sleep(_LOOK_S)


def report_left(asked: AskedBenchmark) -> None:
    """Say where a job is that nobody waits for, and what it waits for."""
    how = "is in the queue" if asked.added else "is in the queue since it was asked for before"
    console.print(f"Job {asked.job.job_id} of run {asked.job.run_id} {how}. The same command waits for its answer")
    console.print(f"  {_standing(asked, _now(asked))}")


def _now(asked: AskedBenchmark) -> Job:
    job = asked.store.job_with_key(asked.job.run_id, asked.job.idempotency_key)
    assert job is not None  # rows are not removed
    return job


def _standing(asked: AskedBenchmark, job: Job) -> str:
    """Describe how a job stands: who computes it, or for which worker it waits."""
    if job.state == "running":
        return f"computed by {job.worker} since {time_here(job.started_utc or '')}"
    store, method = asked.store, asked.method
    data = store.database_path.parent
    here = [sign for sign in living_workers(data, store.clock) if not sign.kinds or KIND.name in sign.kinds]
    hosts = ", ".join(sorted({sign.host for sign in here}))
    listening = (
        f"{counted(len(here), 'worker')} of this folder, on {hosts}, may take it"
        if here
        else "none of this folder listens"
    )
    lacks = missing(method)
    where = f" on a machine with {method.expects} (not this one: {lacks})" if lacks else ""
    start = "" if here and not lacks else f". Start one: `orthocapture worker --kinds {KIND.name} --data {data}`"
    return f"waits for a worker{where}; {listening}{start}"
