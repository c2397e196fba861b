"""The worker's loop: claims a job that its machine can compute, computes it, and records the answer."""

from __future__ import annotations

import importlib
import logging
import math
import os
import socket
import tempfile
import threading
from collections.abc import Callable, Generator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from service.computations import job_kinds, term
from service.computations.job import Handler, JobAnswer, JobContext, handler_of
from service.computations.kind import Demand, JobKind
from service.computations.memory_grants import MemoryGrants, computes_alone
from service.core.disk_space import LEAST_FREE_BYTES
from service.core.errors import ComputeError, IntegrityError, OrthocaptureError, StoreError
from service.core.records.run_events import ClusterHost, ComputedOn
from service.core.run.state import Lane
from service.logs import at
from service.machine.executors import Place, noting_places
from service.machine.resources import processor_model
from service.store.durable_effects import Clock
from service.store.records import Able, Job, LeaseLostError
from service.store.store import Store

if TYPE_CHECKING:
    from service.worker.following import FollowedRuns

# --- what this machine has of what jobs need: others are left to other workers ------------------------------------

_log = logging.getLogger(__name__)
_AGAIN_S = 60.0  # after which it is looked again what is installed


class Abilities:
    """Finds out and remembers what this machine has of what jobs need.

    The queue is searched within a transaction, in which nothing may take long: what is not known yet counts there as
    lacking, and is remembered as a question that `look` answers.

    Attributes:
        able: says by kind and arguments which jobs this machine can compute.
        able_now: the same without those that are to be alone on their machine, while it computes such a job.
    """

    def __init__(self, data: Path, clock: Clock) -> None:
        """Take the data folder, in which all workers of this machine say what they compute."""
        self._data, self._clock = data, clock
        self._has: dict[tuple[str, str], tuple[bool, float]] = {}  # and when it was looked
        self._asked: set[tuple[str, str]] = set()
        kinds = {name: kind for name, kind in job_kinds().items() if kind.lacking}
        self.able: Able = {name: partial(self._can, kind) for name, kind in kinds.items()}
        self.able_now: Able = {name: partial(self._can_now, kind) for name, kind in kinds.items()}

    def look(self) -> bool:
        """Find out what was asked since the last look; return whether the machine has some of it."""
        found = False
        for kind, need in sorted(self._asked):
            lacks = self._lacking(kind, need)
            self._has[kind, need] = not lacks, self._clock.monotonic_s()
            found |= not lacks
            if lacks:
                _log.info("jobs %s that need %s are left to other machines: %s", kind, need, lacks)
        self._asked.clear()
        return found

    def _lacking(self, kind: str, need: str) -> str:
        module, _, function = job_kinds()[kind].lacking.partition(":")
        lacking: Callable[[str], str] = getattr(importlib.import_module(module), function)
        try:
            return lacking(need)
        except OrthocaptureError as error:  # such as two plug-ins of one name
            return str(error)

    def _can_now(self, kind: JobKind[Any, Any], arguments: Mapping[str, Any]) -> bool:
        """Say within a transaction whether this machine can begin a job."""
        return self._can(kind, arguments) and not (_is_alone(kind, arguments) and computes_alone(self._data))

    def _can(self, kind: JobKind[Any, Any], arguments: Mapping[str, Any]) -> bool:
        """Say within a transaction whether this machine can compute a job."""
        try:
            need = kind.needs(kind.read_arguments(arguments))
        except OrthocaptureError:
            return True  # whoever takes it records that its arguments cannot be read
        if not need:
            return True
        has, looked_s = self._has.get((kind.name, need), (False, -math.inf))
        if self._clock.monotonic_s() - looked_s <= _AGAIN_S:
            return has
        self._asked.add((kind.name, need))
        return False


def _is_alone(kind: JobKind[Any, Any], arguments: Mapping[str, Any]) -> bool:
    try:
        return kind.demand(kind.read_arguments(arguments)).alone
    except OrthocaptureError:
        return False


# --- the loop -----------------------------------------------------------------------------------------------------

_LEASE_S = 30.0
_POLL_S = 0.2
_LOOK_S = 2.0  # between looks whether the job was cancelled or takes too long

# Kind → function that computes it, from arguments with references resolved. Tests replace some.
HANDLERS: dict[str, Handler] = {name: handler_of(kind) for name, kind in job_kinds().items()}


def work(
    store: Store,
    *,
    until_idle: bool,
    stop: Callable[[], bool],
    progress: Callable[[str, int, int], None],
    lane: Lane | None = None,
    kinds: tuple[str, ...] | None = None,
    finished: Callable[[], None] = lambda: None,
    end: Callable[[], None] = lambda: None,
) -> int:
    """Compute one job after the other until `stop()`.

    Args:
        store: the data folder's store.
        until_idle: true to end when no job is left.
        stop: called between jobs.
        progress: called with what a job does, how much is done, and the total.
        lane: the lane of jobs to compute: those that a step waits for, or the others; None: all.
        kinds: the kinds of jobs to compute; None: all.
        finished: called after each job.
        end: called from another thread when the job that is computed has been cancelled, or has taken too long; ends
            the process if the computation is to end with it.

    Returns:
        The number of jobs computed.
    """
    name = f"worker {socket.gethostname()}:{os.getpid()}"
    following: FollowedRuns | None = None
    done = 0
    waiting = False
    abilities = Abilities(store.database_path.parent, store.clock)
    with closing(store.changes("jobs")) as changes:
        while not stop():
            waiting = _disk_full(store, told=waiting)
            if waiting:
                store.clock.sleep(_POLL_S)
                continue
            wanted = list(HANDLERS if kinds is None else kinds)
            job = store.claim_job(name, _LEASE_S, kinds=wanted, lane=lane, able=abilities.able_now)
            if job is None:
                if abilities.look():
                    continue
                if until_idle:
                    return done
                changes.wait(_POLL_S)
                continue
            following = following or _following(store)
            _do(store, job, progress, following, end)
            done += 1
            finished()
    return done


def _disk_full(store: Store, *, told: bool) -> bool:
    full = store.free_bytes() < LEAST_FREE_BYTES
    if full and not told:
        _log.warning("the disk of the data folder is nearly full: no job is started until there is space")
    return full


def _following(store: Store) -> FollowedRuns:
    """Make the follower; its module is imported at the first job, like the job's function."""
    from service.worker.following import FollowedRuns  # noqa: PLC0415 - it imports all step kinds, which takes a second

    return FollowedRuns(store)


def _do(
    store: Store,
    job: Job,
    progress: Callable[[str, int, int], None],
    following: FollowedRuns,
    end: Callable[[], None],
) -> None:
    started_s = store.clock.monotonic_s()
    at(run=job.run_id, step=job.step, job=job.job_id)
    answer = JobAnswer({})
    attempt = _JobAttempt(store, job, end)
    grants = MemoryGrants(store.database_path.parent, store.clock)

    @contextmanager
    def begin(demand: Demand) -> Generator[None]:

        def report(why: str) -> None:
            progress(f"{term(job.kind)} {why}", 0, 0)

        with grants.granted(job.job_id, demand.memory_mb, report, alone=demand.alone):
            attempt.limit(demand.limit_s)
            progress(term(job.kind), 0, 0)
            yield

    progress(term(job.kind), 0, 0)
    with noting_places() as places, attempt, tempfile.TemporaryDirectory(prefix="orthocapture-job-") as scratch:
        arguments = following.resolved(job)
        answer = HANDLERS[job.kind](JobContext(arguments, store, Path(scratch), progress, begin, store.events))
    if attempt.over:
        return
    try:
        if attempt.error is not None:
            store.fail_job(job, attempt.error, retry=_worth_another_try(attempt.error))
            following.seal(job.run_id)
            return
        following.finish(job, answer, store.clock.monotonic_s() - started_s, _computed_on(places))
    except LeaseLostError:
        _log.warning("job %s was taken over by another worker; its result stands", job.job_id)


def _computed_on(places: Mapping[Place, int]) -> ComputedOn:
    """Return the record of the processors: this machine's, and those of the cluster's tasks."""
    hosts = (ClusterHost(host=at.host, processor=at.processor, tasks=count) for at, count in sorted(places.items()))
    return ComputedOn(processor=processor_model(), cluster=tuple(hosts))


def _worth_another_try(error: Exception) -> bool:
    """Return whether an error may be temporary; a job that refuses its input would refuse it again."""
    if isinstance(error, OrthocaptureError):
        return not isinstance(error, (ComputeError, IntegrityError))
    return isinstance(error, BrokenProcessPool)  # a helper of the job was killed


class _JobAttempt:
    """Renews a job's lease while it is computed, ends it if it takes too long, and holds the error that ends it.

    `over` says that the job ended meanwhile, so that its answer does not count: it was cancelled, took too long, or
    belongs to another worker.
    """

    def __init__(self, store: Store, job: Job, end: Callable[[], None]) -> None:
        self.error: Exception | None = None
        self.over = False
        self._store, self._job, self._end = store, job, end
        self._limit_s, self._ends_s = math.inf, math.inf
        self._stop = store.clock.signal()
        self._thread = threading.Thread(target=self._renew, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(
        self, _kind: type[BaseException] | None, error: BaseException | None, _traceback: TracebackType | None
    ) -> bool:
        self._stop.set()
        self._thread.join()
        if not isinstance(error, Exception):
            return False
        self.error = error
        if not isinstance(error, OrthocaptureError):
            _log.error("job %s failed", self._job.kind, exc_info=error)
        return True

    def limit(self, limit_s: float) -> None:
        """Let it take so long from now on."""
        self._limit_s, self._ends_s = limit_s, self._store.clock.monotonic_s() + limit_s

    def _renew(self) -> None:
        due_s = self._store.clock.monotonic_s() + _LEASE_S / 3
        while not self._stop.wait(_LOOK_S):
            now_s = self._store.clock.monotonic_s()
            try:
                if now_s >= self._ends_s:
                    self._store.fail_job(self._job, _too_long(self._limit_s), retry=False)
                    break
                if now_s >= due_s:
                    self._store.renew_job(self._job, _LEASE_S)
                    due_s = now_s + _LEASE_S / 3
                elif not self._store.holds_job(self._job):
                    break
            except LeaseLostError:
                break
            except StoreError as error:  # the disk was full or busy for a moment; the lease may outlive it
                _log.warning("the lease of job %s was not renewed: %s", self._job.job_id, error)
        else:
            return
        self.over = True
        _log.warning("job %s has ended and is computed no further", self._job.job_id)
        self._end()


def _too_long(limit_s: float) -> ComputeError:
    return ComputeError(
        f"it was ended after {limit_s / 60:.0f} minutes, many times what such a job takes",
        remedy="See what else keeps the machine busy, and try again; if that does not help, its input may be damaged",
    )
