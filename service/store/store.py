"""The store of a data folder, for the runner, the worker, the web and the command line."""

from __future__ import annotations

import logging
import shutil
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from sqlalchemy import Connection, bindparam, select

from service.core.errors import IntegrityError, OrthocaptureError, StoreError
from service.core.records.base import ArtefactRef
from service.core.records.events import Event, Payload, SiteOpened
from service.core.records.run_events import ComputedOn, JobFinished, RunStarted
from service.core.run.state import Lane
from service.core.words import storable
from service.store import jobs as queue
from service.store.artefacts import ArtefactFiles, chunks_of, insert_artefacts, open_folder, read_artefacts
from service.store.data_folder import close_to_others, require_access, require_own_mount
from service.store.database.database import PATIENCE_S, Changes, Channel, Database, HeardChanges, PolledChanges
from service.store.database.engine import DATABASE_NAME, LOOK, RESTORE, database_path
from service.store.database.opening import open_database, require_database
from service.store.database.tables import artefacts, events, heads, runs
from service.store.durable_effects import Ages, Clock, DurableFiles, Files, IdSource, RandomIds, SystemClock
from service.store.events import append, read_events, to_event
from service.store.objects.reading import SpoolReader
from service.store.records import (
    EVERY_JOB,
    SITE,
    Able,
    Artefact,
    Checkpoint,
    Job,
    NewArtefact,
    NewJob,
    RunRow,
    Timestamp,
    UnknownRunError,
)
from service.store.runs import (
    RunLease,
    acquire,
    begin_chain,
    check_lease,
    held_runs,
    is_held,
    read_open_runs,
    read_runs,
    resolve_run,
)
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps
from service.store.signatures.log import SeenSignatures, SignatureLog

_HEAD = select(heads.c.seq).where(heads.c.run_id == bindparam("run"))  # put together once, for they are asked often
_RUN = select(runs.c.run_id).where(runs.c.run_id == bindparam("run"))
_OWN_KINDS = frozenset({"run_started", "site_opened", "job_enqueued", "job_finished", "job_failed"})


class Store:
    """Events, artefacts and jobs of all runs in one data folder. Several processes and threads may use it at once.

    Methods raise only StoreError and its subclasses; a call that raised has recorded nothing.
    """

    def __init__(
        self,
        database: Database,
        folder: ArtefactFiles,
        files: Files,
        clock: Clock,
        ids: IdSource,
        path: Path,
        signature_log: SignatureLog,
    ) -> None:
        self._database = database
        self._folder = folder
        self._reader = SpoolReader(path.parent, folder)
        self._files = files
        self._clock = clock
        self._ids = ids
        self.ages = Ages(clock)
        self.database_path = path
        self.sound_until: dict[str, tuple[int, str]] = {}  # chain → number and hash of the last event verified
        self.signature_log = signature_log
        self.seen_signatures = SeenSignatures(signature_log)

    @classmethod
    def open(
        cls,
        data_dir: Path,
        clock: Clock | None = None,
        ids: IdSource | None = None,
        files: Files | None = None,
        *,
        create: bool = True,
        patience_s: float = PATIENCE_S,
    ) -> Store:
        """Open a data folder; with `create`, make it if it does not exist.

        A write waits up to about `patience_s` for other processes that write.
        Raises StoreVersionError for a database of a newer version, StoreError if the folder cannot be used.
        """
        files = files or DurableFiles()
        ids = ids or RandomIds()
        require_access(data_dir)
        if not create:
            require_database(data_dir)
        folder = open_folder(data_dir, files, ids)
        require_own_mount(data_dir)
        close_to_others(data_dir, DATABASE_NAME)
        database = open_database(data_dir, files, patience_s)
        log = SignatureLog(data_dir, files, patience_s)
        return cls(database, folder, files, clock or SystemClock(), ids, database_path(data_dir), log)

    @property
    def database(self) -> Database:
        """The database, for code with tables of its own beside the evidence: people, screens."""
        return self._database

    @property
    def artefact_folder(self) -> Path:
        """The folder of the content-addressed files."""
        return self._folder.folder

    @property
    def files(self) -> Files:
        """The interface through which everything is written that must survive a crash."""
        return self._files

    @property
    def clock(self) -> Clock:
        """The clock that gives the times of events."""
        return self._clock

    def free_bytes(self) -> int:
        """Return the free space in bytes on the disk of the data folder. Raises StoreError."""
        try:
            return shutil.disk_usage(self.database_path.parent).free
        except OSError as error:
            raise StoreError(
                f"the data folder cannot be reached: {error.strerror}", where=str(error.filename), remedy=LOOK
            ) from error

    def changes(self, channel: Channel) -> Changes:
        """Return what to wait with until events ("chains") or jobs may have come; close it in the end.

        A clock of its own, as tests have, passes only by itself: with one, this polls.
        """
        engine = self._database.listening_engine() if isinstance(self._clock, SystemClock) else None
        return PolledChanges(self._clock) if engine is None else HeardChanges(engine, channel, self._clock)

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    # --- files ---

    def put_file(
        self, path: Path, *, kind: str, media_type: str, original_name: str | None = None, sha256: str | None = None
    ) -> ArtefactRef:
        """Copy a file into the store durably. Nothing refers to it until `record`.

        Args:
            path: the file; it is copied and left in place.
            kind: image, raw, scan …, as in ArtefactRef.
            media_type: such as image/jpeg.
            original_name: the device's name for it; defaults to the file's own name.
            sha256: the hash that the driver took on arrival; a copy that differs is refused.
        """
        digest, size = self._folder.put(chunks_of(path), expected_sha256=sha256)
        name = storable(original_name or path.name)
        return ArtefactRef(sha256=digest, kind=kind, media_type=media_type, size_bytes=size, original_name=name)

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Write bytes into the store durably. Nothing refers to them until `record`."""
        digest, size = self._folder.put([data])
        return ArtefactRef(
            sha256=digest, kind=kind, media_type=media_type, size_bytes=size, original_name=storable(original_name)
        )

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return the read-only file of an artefact; one that was freed here is fetched from the site's object store.

        Raises IntegrityError if it is missing or, with `verify`, altered.
        """
        return self._reader.path(sha256, verify=verify)

    # --- runs and events ---

    def create_run(self, payload: RunStarted, actor: str, artefacts: Sequence[NewArtefact]) -> str:
        """Begin a run with its first event and its artefacts, protocol and rig among them. Returns the run's name."""
        run_id = self._ids.new_run(self._clock.utc_now())
        with self._database.writing() as connection:
            begin_chain(connection, self._clock, self._folder, run_id, payload, actor, artefacts)
        return run_id

    def record_site(
        self, payloads: Sequence[Payload], *, actor: str, software: Mapping[str, str] | None = None
    ) -> list[Event]:
        """Append events to the site's chain, beginning it if need be; `software` goes into its first event."""
        with self._database.writing() as connection:
            return self.append_site(connection, payloads, actor=actor, software=software)

    def append_site(
        self,
        connection: Connection,
        payloads: Sequence[Payload],
        *,
        actor: str,
        software: Mapping[str, str] | None = None,
        artefacts: Sequence[NewArtefact] = (),
    ) -> list[Event]:
        """Do as `record_site` in a transaction of `database.writing()`, so that action and record are atomic."""
        if connection.execute(select(runs.c.run_id).where(runs.c.run_id == SITE)).first() is None:
            opened = SiteOpened(software=dict(software or {}))
            begin_chain(connection, self._clock, self._folder, SITE, opened, actor, ())
        events = append(connection, self._clock, SITE, payloads, actor)
        insert_artefacts(connection, self._folder, events, artefacts)
        return events

    def append(self, connection: Connection, run_id: str, payloads: Sequence[Payload], *, actor: str) -> list[Event]:
        """Append to a run's chain within a transaction of `database.writing()`. Raises UnknownRunError."""
        self._require_run(connection, run_id)
        return append(connection, self._clock, run_id, payloads, actor)

    def runs(self) -> list[RunRow]:
        """Return all runs, oldest first."""
        with self._database.reading() as connection:
            return read_runs(connection)

    def open_runs(self) -> set[str]:
        """Return names of the runs that have not ended, from the index of events without reading them all."""
        with self._database.reading() as connection:
            return read_open_runs(connection)

    def find_run(self, name: str) -> str:
        """Return the run called `name`: a full name, an unambiguous beginning, or `latest`.

        Raises UnknownRunError.
        """
        return resolve_run(self.runs(), name)

    def record(
        self,
        run_id: str,
        payloads: Sequence[Payload],
        *,
        actor: str,
        artefacts: Sequence[NewArtefact] = (),
        jobs: Sequence[NewJob] = (),
        lease: RunLease | None = None,
    ) -> list[Event]:
        """Append events, artefact rows and jobs in one transaction; all of it is durable on return, or none.

        Each job also appends a JobEnqueued after the payloads; a job whose key the run already has is left out.
        With `lease`, raises LeaseLostError if another process has taken over the run.
        """
        for payload in payloads:
            if payload.kind in _OWN_KINDS:
                raise StoreError(
                    f"{payload.kind} is written by the store itself", remedy="Call the method of that name"
                )
        with self._database.writing() as connection:
            self._require_run(connection, run_id)
            if lease is not None:
                check_lease(connection, lease)
            events = append(connection, self._clock, run_id, payloads, actor)
            events += queue.enqueue(connection, self._clock, self._ids, run_id, jobs, actor=actor)
            insert_artefacts(connection, self._folder, events, artefacts)
        tell(events)
        return events

    def events(self, run_id: str, after_seq: int = 0) -> list[Event]:
        """Return a run's events after a sequence number, in order.

        The chain is not verified (verification.verify does).
        """
        with self._database.reading() as connection:
            self._require_run(connection, run_id)
            return read_events(connection, run_id, after_seq)

    def first_event(self, run_id: str) -> Event:
        """Return a run's first event, without reading the others. Raises IntegrityError if it is missing."""
        with self._database.reading() as connection:
            self._require_run(connection, run_id)
            row = connection.execute(select(events).where(events.c.run_id == run_id, events.c.seq == 1)).one_or_none()
        if row is None:
            raise IntegrityError("the run has no first event", where=run_id, remedy=RESTORE)
        return to_event(row)

    def head(self, run_id: str) -> int:
        """Return the sequence number of a run's last event. Raises UnknownRunError."""
        with self._database.reading() as connection:
            seq: int | None = connection.execute(_HEAD, {"run": run_id}).scalar()
        if seq is None:
            raise UnknownRunError(f"there is no run {run_id!r}", where=str(self.database_path))
        return seq

    def artefacts(self, run_id: str) -> list[Artefact]:
        """Return all recorded artefacts of a run, in the order of its events."""
        with self._database.reading() as connection:
            self._require_run(connection, run_id)
            return read_artefacts(connection, run_id)

    def holds(self, run_id: str, sha256: str) -> bool:
        """Return whether a run has recorded a file with this content."""
        found = select(artefacts.c.seq).where(artefacts.c.sha256 == sha256, artefacts.c.run_id == run_id).limit(1)
        with self._database.reading() as connection:
            return connection.execute(found).first() is not None

    def checkpoints(self, run_id: str) -> list[Checkpoint]:
        """Return all checkpoints of a run's or the site's (SITE) chain, oldest first (made by signatures.signing)."""
        with self._database.reading() as connection:
            return read_checkpoints(connection, run_id)

    def timestamps(self, run_id: str) -> list[Timestamp]:
        """Return the time stamps on a run's checkpoints, oldest first."""
        with self._database.reading() as connection:
            return read_timestamps(connection, run_id)

    def lease(self, run_id: str, holder: str, seconds: float) -> RunLease:
        """Acquire the sole right to drive a run. Raises LeaseHeldError while a living process holds it."""
        with self._database.reading() as connection:
            self._require_run(connection, run_id)
        return acquire(self._database, self._clock, self._ids, run_id=run_id, holder=holder, seconds=seconds)

    def driven(self, run_id: str) -> bool:
        """Return whether a living process holds the lease of a run."""
        with self._database.reading() as connection:
            return is_held(connection, self._clock, run_id)

    def driven_runs(self) -> list[str]:
        """Return names of all runs whose lease a living process holds."""
        with self._database.reading() as connection:
            return held_runs(connection, self._clock)

    def _require_run(self, connection: Connection, run_id: str) -> None:
        if connection.execute(_RUN, {"run": run_id}).first() is None:
            raise UnknownRunError(f"there is no run {run_id!r}", where=str(self.database_path))

    # --- jobs ---

    def jobs(self, run_id: str) -> list[Job]:
        """Return all jobs of a run, oldest first."""
        with self._database.reading() as connection:
            self._require_run(connection, run_id)
            return queue.read_jobs(connection, run_id)

    def job_with_key(self, run_id: str, idempotency_key: str) -> Job | None:
        """Return the job of a run that was enqueued with this key, or None."""
        with self._database.reading() as connection:
            return queue.find_by_key(connection, run_id, idempotency_key)

    def jobs_started(self, run_id: str) -> dict[str, str]:
        """Start time (UTC) of each job of a run that is being computed, by the job's name."""
        with self._database.reading() as connection:
            return queue.started(connection, self.clock, run_id)

    def open_jobs(
        self,
        run_id: str | None = None,
        *,
        lane: Lane | None = None,
        kinds: Collection[str] | None = None,
        able: Able = EVERY_JOB,
    ) -> int:
        """Return the number of jobs of a run, or of all runs, that are queued or being computed.

        `lane` counts only jobs that a person or a step waits for ("waited"), or only the others ("background");
        `kinds` only those of these kinds; `able` leaves out those that this machine cannot compute.
        """
        with self._database.reading() as connection:
            return queue.open_jobs(connection, run_id, lane, kinds, able)

    def claim_job(
        self,
        worker: str,
        lease_s: float,
        kinds: Collection[str] | None = None,
        *,
        run_id: str | None = None,
        lane: Lane | None = None,
        able: Able = EVERY_JOB,
    ) -> Job | None:
        """Claim the first open job by priority, then age, for `lease_s` seconds; None if there is none.

        `kinds`, `run_id` and `lane` restrict the choice: `lane` to jobs that a person or a step waits for ("waited"),
        or to the others ("background"), `able` to those that this machine can compute.
        """
        with self._database.writing() as connection:
            choice = queue.JobChoice(kinds, run_id, lane, able)
            return queue.claim(connection, self._clock, self._ids, worker=worker, lease_s=lease_s, choice=choice)

    def renew_job(self, job: Job, lease_s: float) -> Job:
        """Keep a job for another `lease_s` seconds. Raises LeaseLostError."""
        with self._database.writing() as connection:
            return queue.renew(connection, self._clock, job, lease_s)

    def finish_job(
        self,
        job: Job,
        *,
        measures: Mapping[str, float],
        duration_s: float,
        result: Mapping[str, Any] | None = None,
        artefacts: Sequence[NewArtefact] = (),
        late_s: float | None = None,
        computed_on: ComputedOn | None = None,
        follow: tuple[int, Callable[[Sequence[Event]], Sequence[NewJob]]] | None = None,
    ) -> Event:
        """Append JobFinished with its artefacts and close the job. Raises LeaseLostError.

        Args:
            job: the claimed job.
            measures: the answer's measures.
            duration_s: time that the computation took.
            result: the answer as plain data.
            artefacts: the answer's files.
            late_s: seconds from when the specimen was freed to this answer; None if it is in time.
            computed_on: the processors that computed it; None if they are not known.
            follow: a sequence number and a function that gets all events after it and returns the jobs that follow;
                they are enqueued in the same transaction, so that a crash cannot lose them.
        """
        payload = JobFinished(
            job=job.job_id,
            job_kind=job.kind,
            step=job.step,
            attempt=job.attempt,
            worker=job.worker or "",
            measures=dict(measures),
            artefacts=tuple(artefact.ref for artefact in artefacts),
            result=dict(result or {}),
            duration_s=duration_s,
            late_s=late_s,
            computed_on=computed_on,
        )
        with self._database.writing() as connection:
            event = queue.finish(connection, self._clock, job, payload)
            insert_artefacts(connection, self._folder, [event], artefacts)
            if follow is not None:
                after_seq, following = follow
                new = following(read_events(connection, job.run_id, after_seq))
                queue.enqueue(connection, self._clock, self._ids, job.run_id, new, actor=job.worker or "worker")
        tell([event])
        return event

    def fail_job(self, job: Job, error: Exception, *, retry: bool) -> list[Event]:
        """Queue a job again, or fail it for good if not `retry` or no tries are left. Raises LeaseLostError.

        An error that is not an OrthocaptureError is unexpected: its traceback goes into the record.
        """
        foreseen = isinstance(error, OrthocaptureError)
        name, message = type(error).__name__, str(error) if foreseen else repr(error)
        trace = "" if foreseen else "".join(traceback.format_exception(error))
        with self._database.writing() as connection:
            events = queue.fail(connection, self._clock, job, name, message, retry=retry, traceback=trace)
        tell(events)
        return events

    def holds_job(self, job: Job) -> bool:
        """Return whether a claimed job is still this worker's: not cancelled, not failed, not taken over."""
        with self._database.reading() as connection:
            return queue.holds(connection, job)

    def cancel_job(self, run_id: str, job_id: str, *, actor: str, reason: str) -> Event:
        """End one job by a person's decision; the step that waits for it asks, as for a job that failed.

        Raises IllegalTransitionError if the run has no such job, or it has ended.
        """
        with self._database.writing() as connection:
            self._require_run(connection, run_id)
            event = queue.cancel(connection, self._clock, run_id, job_id, actor=actor, reason=reason)
        tell([event])
        return event

    def release_jobs(self, pids: Collection[int]) -> None:
        """Queue the jobs of these local processes again without counting a try: they were asked to stop and have."""
        with self._database.writing() as connection:
            queue.release(connection, pids)


_log = logging.getLogger(__name__)
_FIELDS = ("step", "attempt", "viewpoint", "device", "job", "job_kind", "duration_s", "note", "error")


def tell(events: Sequence[Event]) -> None:
    """Log one line per event: its kind, number and actor, what it concerns, and an error's message."""
    if not _log.isEnabledFor(logging.INFO):
        return
    for event in events:
        payload = event.payload
        said = {name: getattr(payload, name) for name in _FIELDS if getattr(payload, name, None) is not None}
        words = getattr(payload, "message", None)
        _log.info(
            "%s",
            payload.kind,
            extra={"run": event.run_id, "seq": event.seq, "actor": event.actor, **said}
            | ({"words": words} if words else {}),
        )
