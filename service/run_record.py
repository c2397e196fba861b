"""What is recorded of a run besides its events: its protocol, its jobs that are open, the results still to come."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from service.computations import term
from service.computations.memory_grants import waiting_for_memory
from service.core.errors import IntegrityError
from service.core.protocol import Protocol, parse_protocol
from service.core.records.run_events import RunStarted
from service.core.run.state import lane_of
from service.core.words import time_here
from service.followed_run import RunRecord
from service.steps import params_models
from service.store.database.engine import RESTORE
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
