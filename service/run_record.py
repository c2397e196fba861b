"""The runner's view of the evidence: reading and folding a run's events, and writing new ones."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Literal

from service.core.errors import ComputeError, IntegrityError
from service.core.jobs import arguments_name, job_key
from service.core.protocol.models import Protocol, parse_protocol
from service.core.records.events import ArtefactRef, Event, Payload, RecordedView, RunStarted
from service.core.run.decide import advance, fold
from service.core.run.folded import FoldedRun
from service.core.run.state import JobState, RunState, lane_of
from service.core.text.words import time_here
from service.jobs import term
from service.jobs.memory_grants import waiting_for_memory
from service.steps import params_models
from service.steps.context import JobRequest, JobResult
from service.store.database.engine import RESTORE
from service.store.records import NewArtefact, NewJob
from service.store.runs import RunLease
from service.store.store import Store

if TYPE_CHECKING:
    from service.steps.due_jobs import PendingResult


def recorded_root(store: Store, run_id: str) -> RunStarted:
    """Return the payload of a run's first event. Raises IntegrityError if it is not run_started."""
    root = store.first_event(run_id).payload
    if not isinstance(root, RunStarted):
        raise IntegrityError("the run's first event is not run_started", where=run_id, remedy=RESTORE)
    return root


def recorded_protocol(store: Store, root: RunStarted) -> Protocol:
    """Return the protocol as recorded when a run began.

    Raises IntegrityError if altered, ProtocolError if not readable.
    """
    content = store.artefact_path(root.protocol.sha256, verify=True).read_bytes()
    return parse_protocol(content, params_models(), name=root.protocol.original_name).protocol


@dataclass(frozen=True, slots=True)
class RunRecord(FoldedRun):
    """The record of one run at one moment, and the store that holds its files and jobs."""

    store: Store

    def captures(self, step_id: str) -> tuple[RecordedView, ...]:
        """Return the valid captures of a step's current attempt, in the order of capture."""
        payloads = (self.events[seq - 1].payload for seq in sorted(self.state.steps[step_id].captured.values()))
        return tuple(payload for payload in payloads if isinstance(payload, RecordedView))


@dataclass
class RunFollower:
    """Follows the events of one run and folds them; several threads may use it.

    An impossible event is not added, so every later `refresh` and `now` raises IntegrityError again.
    `leave_not_before_s` is a monotonic time of the store's clock at which the newest leave was not yet recorded.
    """

    store: Store
    run_id: str
    protocol: Protocol
    leave_not_before_s: float = field(init=False, default=-math.inf)
    _events: list[Event] = field(init=False, default_factory=list[Event], repr=False)
    _state: RunState = field(init=False, repr=False)
    _log: RunRecord | None = field(init=False, default=None, repr=False)  # of the newest state, made on request
    _looked_s: float = field(init=False, default=-math.inf)
    _reading: Lock = field(init=False, default_factory=Lock, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._state = fold(self.protocol, [])
        self.refresh()

    @property
    def state(self) -> RunState:
        """The state as of the last read."""
        return self._state

    def refresh(self) -> RunState:
        """Read what other processes (worker, command line, web) have appended. Raises IntegrityError."""
        with self._reading:
            return self._read()

    def now(self) -> RunRecord:
        """Return the record up to now. Raises IntegrityError for an impossible event."""
        with self._reading:
            state = self._read()
            if self._log is None or self._log.state is not state:
                self._log = RunRecord(self.run_id, self.protocol, tuple(self._events), state, self.store)
            return self._log

    def _read(self) -> RunState:
        leave, looked_s = self._state.leave, self.store.clock.monotonic_s()
        known = len(self._events)
        if self.store.head(self.run_id) != known:  # steps that wait look often, and seldom is anything new
            for event in self.store.events(self.run_id, after_seq=known):
                # Fold first: an event that is refused must not be stored.
                self._state = advance(self.protocol, self._state, event)
                self._events.append(event)
        if self._state.leave != leave:
            self.leave_not_before_s = self._looked_s
        self._looked_s = looked_s
        return self._state


def read_log(store: Store, run_id: str, protocol: Protocol) -> RunRecord:
    """Return a run's record as of now, for a single read. Raises IntegrityError for an impossible event."""
    return RunFollower(store, run_id, protocol).now()


def results_to_come(log: RunRecord) -> list[PendingResult]:
    """Return the planned registrations that have not arrived yet, with the time left; empty if all have."""
    from service.steps.due_jobs import missing_results  # noqa: PLC0415 - most job kinds

    started = log.store.jobs_started(log.run_id)
    cores = os.cpu_count() or 1
    left = missing_results(log.protocol, log.state, started, log.store.clock.utc_now().isoformat(), cores)
    return [replace(one, waits=not started) for one in left]


@dataclass(frozen=True, slots=True)
class OpenJob:
    """A job of a run that waits or is computed: its name, step and label, and its state."""

    job: str
    step: str
    words: str
    standing: str

    @property
    def text(self) -> str:
        """The comment's text on a line of its own."""
        return f"{self.words} of step {self.step}, {self.standing}"


def open_jobs(log: RunRecord) -> list[OpenJob]:
    """Return the jobs of a run that are computed, and those in the queue for which a step waits, the oldest first."""
    waiting = waiting_for_memory(log.store.database_path.parent)
    started = log.store.jobs_started(log.run_id)
    jobs = [(name, job) for name, step in log.state.steps.items() for job in step.jobs.values()]
    found: list[OpenJob] = []
    for step, job in sorted(jobs, key=lambda one: one[1].enqueued_seq):
        since = started.get(job.job)
        if job.status == "enqueued" and (since is not None or lane_of(job.priority) == "waited"):
            standing = waiting.get(job.job) or ("in the queue" if since is None else f"since {time_here(since)}")
            found.append(OpenJob(job.job, step, term(job.kind), standing))
    return found


@dataclass
class StepEvidence:
    """The evidence interface (service.steps.context.Evidence) for one execution of one step."""

    log: RunFollower
    lease: RunLease
    step: str
    attempt: int
    checkpoint: Callable[[], None]
    progress: Callable[[str, int, int], None]
    wait: Callable[[float], None]
    space: Callable[[], None]

    def record(self, *payloads: Payload, artefacts: tuple[NewArtefact, ...] = (), actor: str = "runner") -> None:
        """Append events and artefact rows in one transaction."""
        self.log.store.record(self.log.run_id, payloads, actor=actor, artefacts=artefacts, lease=self.lease)

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Copy a file into the store durably; nothing refers to it until `record`."""
        return self.log.store.put_file(path, kind=kind, media_type=media_type, original_name=original_name)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Write bytes into the store durably; nothing refers to them until `record`."""
        return self.log.store.put_bytes(data, kind=kind, media_type=media_type, original_name=original_name)

    def path(self, ref: ArtefactRef) -> Path:
        """Return the file of an artefact. Raises IntegrityError if it is missing."""
        return self.log.store.artefact_path(ref.sha256)

    def holds(self, sha256: str) -> bool:
        """Return whether the run has recorded a file with this content."""
        return self.log.store.holds(self.log.run_id, sha256)

    def captures(self, step_id: str) -> tuple[RecordedView, ...]:
        """Return the valid captures of a step's current attempt, in the order of capture."""
        return self.log.now().captures(step_id)

    def run_jobs(self, *requests: JobRequest) -> tuple[JobResult, ...]:
        """Enqueue jobs, each only once also after restarts, and wait for their results, returned in order.

        Raises ComputeError with the worker's message if a job failed for good.
        """
        keys = [self._key(request) for request in requests]
        jobs = [
            NewJob(r.kind, self.step, self.attempt, key, r.arguments, priority=r.priority, version=r.version)
            for r, key in zip(requests, keys, strict=True)
        ]
        self.log.store.record(self.log.run_id, [], actor="runner", jobs=jobs, lease=self.lease)
        while True:
            self.checkpoint()
            self.space()  # workers begin no jobs while the disk is nearly full
            state = self.log.refresh()
            mine = {job.idempotency_key: job for job in state.steps[self.step].jobs.values()}
            if any(key not in mine for key in keys):
                raise IntegrityError(
                    "a job just enqueued is not in the record",
                    where=f"step {self.step}",
                    remedy="Run `orthocapture audit verify` on the data folder",
                )
            for key in keys:
                if mine[key].status == "failed":
                    raise ComputeError(
                        f"the worker could not do {term(mine[key].kind)}: {mine[key].message}",
                        where=f"step {self.step}",
                        remedy="Correct what the message names, or take what is missing; then try again",
                    )
            done = sum(mine[key].status == "finished" for key in keys)
            waiting = waiting_for_memory(self.log.store.database_path.parent)
            left = [mine[key] for key in keys if mine[key].status != "finished"]
            doing = dict.fromkeys(f"{term(job.kind)} {waiting.get(job.job, '')}".rstrip() for job in left)
            self.progress(", ".join(doing) or "computed", done, len(keys))
            if done == len(keys):
                return tuple(JobResult.of(mine[key]) for key in keys)
            self.wait(0.2)

    def enqueue(self, request: JobRequest, name: str) -> None:
        """Enqueue a job without waiting for it, unless the same work is already enqueued under this name."""
        key = job_key(self.log.refresh(), self.step, request.kind, name)
        if all(job.idempotency_key != key for job in self.jobs(self.step)):
            job = NewJob(
                request.kind,
                self.step,
                self.attempt,
                key,
                request.arguments,
                priority=request.priority,
                version=request.version,
            )
            self.log.store.record(self.log.run_id, [], actor="runner", jobs=[job], lease=self.lease)

    def asked(self) -> tuple[Literal["release", "finish"], ...]:
        """Return what people at screens have asked of this step, in order."""
        return self.log.refresh().steps[self.step].asked

    def computing(self) -> bool:
        """Return whether a worker computes a job of this run at this moment."""
        return bool(self.log.store.jobs_started(self.log.run_id))

    def jobs(self, step_id: str) -> tuple[JobState, ...]:
        """Return the jobs of a step, in the order in which they were enqueued."""
        jobs = self.log.refresh().steps[step_id].jobs.values()
        return tuple(sorted(jobs, key=lambda job: job.enqueued_seq))

    def state(self) -> RunState:
        """Return the run's state as of now. Raises IntegrityError for an impossible event."""
        return self.log.refresh()

    def require_space(self) -> None:
        """Raise SpaceShortError if the disk is nearly full."""
        self.space()

    def _key(self, request: JobRequest) -> str:
        """Return the same key for the same work, so that a restart or retry reuses the result."""
        return job_key(self.log.refresh(), self.step, request.kind, arguments_name(request.arguments))
