"""Verify a data folder against its own evidence, and list a run's evidence. Opens everything read-only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, select, text

from service.core.errors import StoreError
from service.store import audit_checks as checks
from service.store.artefacts import TEMPORARY, hash_file, read_artefacts, relative_path
from service.store.audit_checks import Fault, FileState
from service.store.database import database_path, open_read_only
from service.store.errors import UnknownRunError
from service.store.events import read_events
from service.store.records import Artefact, RunRow
from service.store.seam import DurableFiles
from service.store.store import read_runs
from service.store.tables import TRIGGERS, artefacts, events, heads, jobs, runs

Progress = Callable[[str, int, int], None]  # what is being done, done, total (bytes)


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What was checked and what is wrong. `ok` means no fault; notes are no faults."""

    data_dir: str
    runs: tuple[str, ...]
    heads: Mapping[str, str]  # run → sha256 of its last event: compare it with one written down elsewhere
    events: int
    artefacts: int
    files: int
    bytes_hashed: int
    jobs: int
    faults: tuple[Fault, ...]  # in the order of the chain
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the evidence verifies."""
        return not self.faults

    @property
    def first_fault(self) -> Fault | None:
        """The earliest fault."""
        return self.faults[0] if self.faults else None


@dataclass(frozen=True, slots=True)
class EvidenceRecord:
    """One event of a run with the artefacts that it brought, for people to read."""

    seq: int
    at_utc: str
    monotonic_s: float
    actor: str
    kind: str
    summary: str
    sha256: str
    artefacts: tuple[Artefact, ...]


def verify(data_dir: Path, run_id: str | None = None, progress: Progress | None = None) -> AuditReport:
    """Walk the chain and hash every file again, of one run or of all.

    A chain rewritten from some event to its end, hashes included, verifies by itself; it shows in `heads`,
    which then differ from those written down before.

    Raises:
        UnknownRunError: there is no such run.
        StoreError: there is no database, or it is not readable as one.
    """
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            evidence = _read(connection, run_id)
    finally:
        database.close()
    folder = data_dir / "artefacts"
    files, hashed = _hash_files(folder, evidence, progress)
    faults: list[Fault] = [Fault(None, None, "", problem) for problem in evidence.damage]
    for run in evidence.run_ids:
        faults += checks.run_faults(
            run,
            run_rows=[row for row in evidence.runs if row["run_id"] == run],
            head_rows=[row for row in evidence.heads if row["run_id"] == run],
            event_rows=[row for row in evidence.events if row["run_id"] == run],
            artefact_rows=[row for row in evidence.artefacts if row["run_id"] == run],
            job_rows=[row for row in evidence.jobs if row["run_id"] == run],
            files=files,
        )
    notes, foreign = _unlisted(folder, evidence.every_sha256)
    faults += foreign
    faults += [
        Fault(
            None, None, database_path(data_dir).name, f"the trigger {name} is missing: the evidence could be changed"
        )
        for name in TRIGGERS
        if name not in evidence.triggers
    ]
    return AuditReport(
        data_dir=str(data_dir),
        runs=evidence.run_ids,
        heads={row["run_id"]: row["sha256"] for row in evidence.heads},
        events=len(evidence.events),
        artefacts=len(evidence.artefacts),
        files=len(files),
        bytes_hashed=hashed,
        jobs=len(evidence.jobs),
        faults=tuple(faults),
        notes=tuple(notes),
    )


def show(data_dir: Path, run_id: str) -> list[EvidenceRecord]:
    """The events of a run, oldest first. Raises UnknownRunError, StoreError."""
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            if run_id not in {run.run_id for run in read_runs(connection)}:
                raise UnknownRunError(f"there is no run {run_id!r}", where=str(database_path(data_dir)))
            recorded = read_events(connection, run_id, 0)
            brought = read_artefacts(connection, run_id)
    finally:
        database.close()
    return [
        EvidenceRecord(
            seq=event.seq,
            at_utc=event.at_utc,
            monotonic_s=event.monotonic_s,
            actor=event.actor,
            kind=event.payload.kind,
            summary=checks.summary(event.payload.model_dump(mode="json")),
            sha256=event.sha256,
            artefacts=tuple(artefact for artefact in brought if artefact.seq == event.seq),
        )
        for event in recorded
    ]


def list_runs(data_dir: Path) -> list[RunRow]:
    """All runs of a data folder, oldest first, read-only. Raises StoreError."""
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            return read_runs(connection)
    finally:
        database.close()


@dataclass(frozen=True, slots=True)
class _Evidence:
    run_ids: tuple[str, ...]
    runs: list[dict[str, Any]]
    heads: list[dict[str, Any]]
    events: list[dict[str, Any]]
    artefacts: list[dict[str, Any]]
    jobs: list[dict[str, Any]]
    every_sha256: frozenset[str]
    triggers: frozenset[str]
    damage: tuple[str, ...]


def _read(connection: Connection, run_id: str | None) -> _Evidence:
    damage = [str(row[0]) for row in connection.execute(text("PRAGMA quick_check(5)"))]
    known = set(connection.execute(select(runs.c.run_id)).scalars())
    # A run whose row was deleted is still there in its events.
    known |= set(connection.execute(select(events.c.run_id).distinct()).scalars())
    if run_id is not None and run_id not in known:
        raise UnknownRunError(f"there is no run {run_id!r}", remedy="List the runs with `orthocapture status`")
    chosen = tuple(sorted(known)) if run_id is None else (run_id,)

    def rows(statement: Any) -> list[dict[str, Any]]:
        return [dict(row) for row in connection.execute(statement).mappings() if row["run_id"] in chosen]

    return _Evidence(
        run_ids=chosen,
        runs=rows(select(runs)),
        heads=rows(select(heads)),
        events=rows(select(events).order_by(events.c.run_id, events.c.seq)),
        artefacts=rows(select(artefacts).order_by(artefacts.c.run_id, artefacts.c.seq, artefacts.c.position)),
        jobs=rows(select(jobs).order_by(jobs.c.position)),
        every_sha256=frozenset(connection.execute(select(artefacts.c.sha256)).scalars()),
        triggers=frozenset(
            connection.execute(text("SELECT name FROM sqlite_master WHERE type = 'trigger'")).scalars()
        ),
        damage=tuple(f"SQLite finds the database damaged: {line}" for line in damage if line != "ok"),
    )


def _hash_files(folder: Path, evidence: _Evidence, progress: Progress | None) -> tuple[dict[str, FileState], int]:
    wanted = {row["sha256"]: int(row["size_bytes"]) for row in evidence.artefacts}
    total, done = sum(wanted.values()), 0
    states: dict[str, FileState] = {}
    for sha256, size in wanted.items():
        states[sha256] = _file_state(folder, sha256)
        done += size
        if progress is not None:
            progress("hashing files again", done, total)
    return states, sum(state.size for state in states.values())


def _file_state(folder: Path, sha256: str) -> FileState:
    try:
        name = relative_path(sha256)
    except StoreError:
        return FileState(sha256, "", 0, "the row names no SHA-256")
    path = folder / name
    shown = str(Path(folder.name) / name)
    if path.is_symlink() or not path.is_file():
        return FileState(shown, "", 0, "the file is missing")
    try:
        digest, size = hash_file(path)
    except OSError as error:
        return FileState(shown, "", 0, f"the file cannot be read: {error.strerror}")
    return FileState(shown, digest, size, "")


def _unlisted(folder: Path, listed: frozenset[str]) -> tuple[list[str], list[Fault]]:
    """Crash leftovers are notes: half-written temporary files, and whole ones whose row was never committed."""
    notes: list[str] = []
    foreign: list[Fault] = []
    for path in sorted(path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()):
        relative = path.relative_to(folder)
        shown = str(Path(folder.name) / relative)
        if relative.parts[0] == TEMPORARY and path.suffix == ".part":
            notes.append(f"{shown}: left over from an interrupted write; no record refers to it")
        elif path.name in listed and relative == relative_path(path.name):
            continue
        elif not path.is_symlink() and path.is_file() and hash_file(path)[0] == path.name:
            notes.append(
                f"{shown}: stored but never recorded (interrupted before the record); no record refers to it"
            )
        else:
            foreign.append(Fault(None, None, shown, "this file is not in the evidence and is not a crash's leftover"))
    return notes, foreign
