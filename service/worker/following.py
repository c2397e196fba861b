"""What follows a finished job: the jobs that it makes possible, and a signature if the run has ended."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from typing import Any

from service.computations.job import JobAnswer
from service.core.errors import IntegrityError, OrthocaptureError, StoreError
from service.core.gates import late_s
from service.core.jobs import jobs_of, references_in, resolve
from service.core.records.events import Event
from service.core.records.run_events import ComputedOn
from service.core.run.fold import advance
from service.followed_run import RunFollower
from service.run_record import recorded_protocol, recorded_root
from service.steps.due_jobs import due
from service.store.records import Job, NewArtefact, NewJob
from service.store.signatures.signing import checkpoint_here
from service.store.store import Store

_log = logging.getLogger(__name__)


class FollowedRuns:
    """The records of the runs whose jobs a worker computes, read up to the end of the last job."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._logs: dict[str, RunFollower | None] = {}

    def resolved(self, job: Job) -> Mapping[str, Any]:
        """Return a job's arguments with the references to earlier answers resolved.

        Raises:
            IntegrityError: a reference has no answer that still counts.
        """
        if next(references_in(job.arguments), None) is None:
            return job.arguments
        log = self._log_of(job.run_id)
        if log is None:
            raise IntegrityError(
                "the references of the job cannot be resolved without the run's protocol", where=job.job_id
            )
        return resolve(job.arguments, jobs_of(log.refresh()))

    def finish(self, job: Job, answer: JobAnswer, duration_s: float, computed_on: ComputedOn) -> None:
        """Record an answer and, in one transaction, enqueue the jobs that it makes possible. Raises LeaseLostError.

        If the run has ended, the answer is signed at once, because no runner will do it.
        """
        log = self._log_of(job.run_id)
        late: float | None = None
        follow: tuple[int, Callable[[Sequence[Event]], Sequence[NewJob]]] | None = None
        if log is not None:
            state, protocol = log.refresh(), log.protocol
            late = late_s(protocol, state, self._store.clock.utc_now().isoformat())
            follow = state.seq, lambda events: due(protocol, reduce(partial(advance, protocol), events, state))
        self._store.finish_job(
            job,
            measures=answer.measures,
            duration_s=duration_s,
            result=answer.result,
            artefacts=[NewArtefact(r, "worker", job.step, job.attempt) for r in answer.artefacts],
            late_s=late,
            computed_on=computed_on,
            follow=follow,
        )
        self.seal(job.run_id)

    def seal(self, run_id: str) -> None:
        """Sign the end of a run that is over and has no runner. An unusable key is only logged."""
        log = self._log_of(run_id)
        if log is None or not log.refresh().terminal or self._store.driven(run_id):
            return
        try:
            checkpoint_here(self._store, run_id)
        except StoreError as error:
            _log.warning("the record of %s could not be signed: %s", run_id, error)

    def _log_of(self, run_id: str) -> RunFollower | None:
        """Return a run's follower; None if this version cannot read its protocol.

        The jobs of such a run are computed, but none are added.
        """
        if run_id not in self._logs:
            try:
                protocol = recorded_protocol(self._store, recorded_root(self._store, run_id))
                self._logs = {run_id: RunFollower(self._store, run_id, protocol)}
            except OrthocaptureError as error:
                _log.warning("no jobs can follow those of %s: %s", run_id, error)
                self._logs = {run_id: None}
        return self._logs[run_id]
