"""The job queue: enqueue once, claim with a lease, renew, finish, fail or retry. Rows change; events do not."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from sqlalchemy import ColumnElement, Connection, Row, and_, func, insert, select, true, update

from service.core.errors import IllegalTransitionError
from service.core.records.events import Event
from service.core.records.run_events import JobEnqueued, JobFailed, JobFinished, StepNote
from service.core.run.state import EARLY, Lane
from service.core.words import storable
from service.store.database.database import lease_now_s, notify
from service.store.database.tables import jobs
from service.store.durable_effects import Clock, IdSource, utc_text
from service.store.events import append, canonical, moved_runs, parse_canonical
from service.store.records import EVERY_JOB, Able, Job, LeaseLostError, NewJob
from service.store.runs import ProcessIdentity, identity_of, identity_values

ACTOR = "store"  # actor of events about a worker that is gone
CANCELLED = "JobCancelled"  # as the error of a job that a person has cancelled

_NEXT_POSITION = select(func.coalesce(func.max(jobs.c.position), 0) + 1).scalar_subquery()


def enqueue(
    connection: Connection, clock: Clock, ids: IdSource, run_id: str, new: Sequence[NewJob], *, actor: str
) -> list[Event]:
    """Append JobEnqueued and insert a row for every job whose key the run does not have yet. Returns the events."""
    appended: list[Event] = []
    for job in new:
        if find_by_key(connection, run_id, job.idempotency_key) is not None:
            continue
        payload = JobEnqueued(
            job=ids.new_job(),
            job_kind=job.kind,
            step=job.step,
            attempt=job.attempt,
            idempotency_key=job.idempotency_key,
            arguments=dict(job.arguments),
            priority=job.priority,
            version=job.version,
        )
        (event,) = append(connection, clock, run_id, [payload], actor)
        made = cast(JobEnqueued, event.payload)  # its texts are storable
        connection.execute(
            insert(jobs).values(
                position=_NEXT_POSITION,
                job_id=made.job,
                run_id=run_id,
                kind=made.job_kind,
                step=made.step,
                attempt=made.attempt,
                idempotency_key=made.idempotency_key,
                arguments=canonical(made.model_dump(mode="json")["arguments"]),
                state="queued",
                tries=0,
                try_limit=job.try_limit,
                enqueued_seq=event.seq,
                enqueued_utc=event.at_utc,
                priority=job.priority,
            )
        )
        appended.append(event)
    if appended:
        notify(connection, "jobs", run_id)
    return appended


def find_by_key(connection: Connection, run_id: str, idempotency_key: str) -> Job | None:
    """Return the job of a run with this key, or None."""
    row = connection.execute(
        select(jobs).where(jobs.c.run_id == run_id, jobs.c.idempotency_key == storable(idempotency_key))
    ).one_or_none()
    return None if row is None else to_job(row)


def read_jobs(connection: Connection, run_id: str) -> list[Job]:
    """Return all jobs of a run, oldest first."""
    return [
        to_job(row)
        for row in connection.execute(select(jobs).where(jobs.c.run_id == run_id).order_by(jobs.c.position))
    ]


def open_jobs(
    connection: Connection,
    run_id: str | None,
    lane: Lane | None,
    kinds: Collection[str] | None = None,
    able: Able = EVERY_JOB,
) -> int:
    """Return the number of jobs queued or being computed, of one run or all, in one lane or both, of some kinds.

    With `able`, those that this machine cannot compute are not counted.
    """
    statement = select(jobs.c.kind, func.count().label("open"))
    statement = statement.where(jobs.c.state.in_(("queued", "running")), _of_lane(lane))
    if run_id is not None:
        statement = statement.where(jobs.c.run_id == run_id)
    if kinds is not None:
        statement = statement.where(jobs.c.kind.in_(tuple(kinds)))
    elsewhere = moved_runs(connection)
    if elsewhere:
        statement = statement.where(jobs.c.run_id.not_in(elsewhere))
    counts = {row.kind: row.open for row in connection.execute(statement.group_by(jobs.c.kind))}
    judged = able.keys() & counts.keys()
    if judged:
        rows = connection.execute(
            statement.with_only_columns(jobs.c.kind, jobs.c.arguments).where(jobs.c.kind.in_(judged))
        )
        counts |= dict.fromkeys(judged, 0)
        for row in rows:
            counts[row.kind] += able[row.kind](parse_canonical(row.arguments))
    return sum(counts.values())


def started(connection: Connection, clock: Clock, run_id: str) -> dict[str, str]:
    """Start time (UTC) of each job of a run that a worker computes and whose lease it renews, by the job's name."""
    running = select(jobs.c.job_id, jobs.c.started_utc).where(
        jobs.c.run_id == run_id, jobs.c.state == "running", jobs.c.until_utc_s > lease_now_s(connection, clock)
    )
    return {row.job_id: row.started_utc for row in connection.execute(running)}


@dataclass(frozen=True, slots=True)
class JobChoice:
    """The jobs that a worker may claim; None allows every kind, every run, every lane."""

    kinds: Collection[str] | None
    run_id: str | None
    lane: Lane | None
    able: Able

    def condition(self) -> ColumnElement[bool]:
        """Return the choice as a condition on the rows of `jobs`."""
        return and_(
            _of_lane(self.lane),
            true() if self.kinds is None else jobs.c.kind.in_(tuple(self.kinds)),
            true() if self.run_id is None else jobs.c.run_id == self.run_id,
        )

    def allows(self, row: Row[Any]) -> bool:
        """Return whether the machine can compute a job that meets the condition."""
        able = self.able.get(row.kind)
        return able is None or able(parse_canonical(row.arguments))


def claim(
    connection: Connection, clock: Clock, ids: IdSource, *, worker: str, lease_s: float, choice: JobChoice
) -> Job | None:
    """Claim the oldest job of the highest priority that is queued or that its worker has lost; None if there is none.

    A worker loses a job when it dies or its lease expires. A job that has lost its worker `try_limit` times is failed
    here, so that it is not retried for ever.
    """
    now = clock.utc_now()
    unfinished = jobs.c.state.in_(("queued", "running"))
    elsewhere = moved_runs(connection)
    here = jobs.c.run_id.not_in(elsewhere) if elsewhere else true()
    ordered = select(jobs).where(unfinished, here, choice.condition()).order_by(jobs.c.priority, jobs.c.position)
    for row in connection.execute(ordered).all():
        if not choice.allows(row) or (row.state == "running" and not _take_over(connection, clock, row)):
            continue
        connection.execute(
            update(jobs)
            .where(jobs.c.job_id == row.job_id)
            .values(
                state="running",
                tries=row.tries + 1,
                worker=worker,
                token=ids.new_token(),
                until_utc_s=lease_now_s(connection, clock) + lease_s,
                started_utc=utc_text(now),
                **identity_values(ProcessIdentity.of_this_process()),
            )
        )
        return to_job(connection.execute(select(jobs).where(jobs.c.job_id == row.job_id)).one())
    return None


def _take_over(connection: Connection, clock: Clock, row: Row[Any]) -> bool:
    """Return whether another worker may have this running job.

    Records the loss of its worker, and fails the job at its limit of tries.
    """
    if lease_now_s(connection, clock) < row.until_utc_s and identity_of(row).life() != "dead":
        return False
    _note(connection, clock, row, actor=ACTOR, note="job_lease_lost", data={"worker": row.worker})
    if row.tries < row.try_limit:
        return True
    message = f"the worker died or stopped answering {row.tries} times"
    _end_failed(connection, clock, row, actor=ACTOR, error="WorkerLost", message=message)
    return False


def _of_lane(lane: Lane | None) -> ColumnElement[bool]:
    if lane is None:
        return true()
    return jobs.c.priority < EARLY if lane == "waited" else jobs.c.priority >= EARLY


def renew(connection: Connection, clock: Clock, job: Job, lease_s: float) -> Job:
    """Extend the lease on a job to `lease_s` seconds from now. Raises LeaseLostError."""
    held_row(connection, job)
    until = lease_now_s(connection, clock) + lease_s
    connection.execute(update(jobs).where(jobs.c.job_id == job.job_id).values(until_utc_s=until))
    return to_job(connection.execute(select(jobs).where(jobs.c.job_id == job.job_id)).one())


def finish(connection: Connection, clock: Clock, job: Job, payload: JobFinished) -> Event:
    """Append the result and close the job. Raises LeaseLostError if another worker has taken the job."""
    row = held_row(connection, job)
    (event,) = append(connection, clock, job.run_id, [payload], row.worker)
    _end(connection, row, event, state="finished", error=None)
    return event


def release(connection: Connection, pids: Collection[int]) -> None:
    """Queue the jobs of these local processes again without counting a try: they were asked to stop and have."""
    here = ProcessIdentity.of_this_process()
    mine = (jobs.c.state == "running", jobs.c.host == here.host, jobs.c.boot == here.boot, jobs.c.pid.in_(pids))
    values = {"state": "queued", "tries": jobs.c.tries - 1, "token": None, "until_utc_s": None}
    connection.execute(update(jobs).where(*mine).values(**values))


def fail(
    connection: Connection, clock: Clock, job: Job, error: str, message: str, *, retry: bool, traceback: str = ""
) -> list[Event]:
    """Put the job back into the queue, or fail it for good if not `retry` or its tries are used up.

    Raises LeaseLostError if another worker has taken the job.
    """
    row = held_row(connection, job)
    if not retry or row.tries >= row.try_limit:
        end = _end_failed(connection, clock, row, actor=row.worker, error=error, message=message, traceback=traceback)
        return [end]
    event = _note(
        connection,
        clock,
        row,
        actor=row.worker,
        note="job_failed_will_retry",
        data={"error": error, "message": message} | ({"traceback": traceback} if traceback else {}),
    )
    connection.execute(
        update(jobs)
        .where(jobs.c.job_id == job.job_id)
        .values(state="queued", token=None, until_utc_s=None, error=storable(f"{error}: {message}"))
    )
    notify(connection, "jobs", job.run_id)
    return [event]


def holds(connection: Connection, job: Job) -> bool:
    """Return whether the lease of a job is still `job.token`."""
    row = connection.execute(select(jobs.c.state, jobs.c.token).where(jobs.c.job_id == job.job_id)).one_or_none()
    return row is not None and row.state == "running" and row.token == job.token


def cancel(connection: Connection, clock: Clock, run_id: str, job_id: str, *, actor: str, reason: str) -> Event:
    """Fail a job for good because a person has decided so; whoever computes it will find its lease lost.

    Raises IllegalTransitionError if the run has no such job, or it has ended.
    """
    row = connection.execute(select(jobs).where(jobs.c.job_id == job_id, jobs.c.run_id == run_id)).one_or_none()
    if row is None:
        raise IllegalTransitionError(
            f"the run has no job {job_id!r}", where=run_id, remedy="`orthocapture status` lists the jobs that run"
        )
    if row.state not in ("queued", "running"):
        raise IllegalTransitionError(f"the job has {row.state} already", where=job_id)
    payload = JobFailed(
        job=row.job_id,
        job_kind=row.kind,
        step=row.step,
        attempt=row.attempt,
        worker=row.worker or "",
        error=CANCELLED,
        message=f"{actor} cancelled it: {reason}",
    )
    (event,) = append(connection, clock, run_id, [payload], actor)
    _end(connection, row, event, state="failed", error=f"{payload.error}: {payload.message}")
    return event


def held_row(connection: Connection, job: Job) -> Row[Any]:
    """Return the row of a job whose lease is still `job.token`. Raises LeaseLostError."""
    row = connection.execute(select(jobs).where(jobs.c.job_id == job.job_id)).one_or_none()
    if row is None or row.state != "running" or job.token is None or row.token != job.token:
        state = "gone" if row is None else f"{row.state}, worker {row.worker}"
        raise LeaseLostError(
            f"job {job.job_id} is no longer this worker's ({state})",
            where=f"run {job.run_id}, {job.kind} of step {job.step}",
            remedy="Discard the result; the worker that has the job now will finish it",
        )
    return row


def _note(
    connection: Connection, clock: Clock, row: Row[Any], *, actor: str, note: str, data: Mapping[str, Any]
) -> Event:
    payload = StepNote(
        step=row.step,
        attempt=row.attempt,
        note=note,
        data={"job": row.job_id, "job_kind": row.kind, "tries": row.tries, **data},
    )
    (event,) = append(connection, clock, row.run_id, [payload], actor)
    return event


def _end_failed(
    connection: Connection,
    clock: Clock,
    row: Row[Any],
    *,
    actor: str,
    error: str,
    message: str,
    traceback: str = "",
) -> Event:
    payload = JobFailed(
        job=row.job_id,
        job_kind=row.kind,
        step=row.step,
        attempt=row.attempt,
        worker=row.worker,
        error=error,
        message=message,
        traceback=traceback,
    )
    (event,) = append(connection, clock, row.run_id, [payload], actor)
    _end(connection, row, event, state="failed", error=storable(f"{error}: {message}"))
    return event


def _end(connection: Connection, row: Row[Any], event: Event, *, state: str, error: str | None) -> None:
    connection.execute(
        update(jobs)
        .where(jobs.c.job_id == row.job_id)
        .values(state=state, ended_seq=event.seq, ended_utc=event.at_utc, error=error, token=None, until_utc_s=None)
    )


def to_job(row: Row[Any]) -> Job:
    """Return a row of `jobs` as a Job."""
    return Job(
        job_id=row.job_id,
        run_id=row.run_id,
        kind=row.kind,
        step=row.step,
        attempt=row.attempt,
        idempotency_key=row.idempotency_key,
        arguments=parse_canonical(row.arguments),
        state=row.state,
        tries=row.tries,
        try_limit=row.try_limit,
        worker=row.worker,
        token=row.token,
        until_utc_s=row.until_utc_s,
        started_utc=row.started_utc,
        ended_utc=row.ended_utc,
        ended_seq=row.ended_seq,
        error=row.error,
        priority=row.priority,
    )
