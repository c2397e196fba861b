"""Verify the evidence in a data folder, and list a run's evidence. Everything is opened read-only."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, select, text

from service.core.errors import StoreError
from service.store.database.engine import DATABASE_NAME, RESTORE, database_path, open_read_only
from service.store.database.tables import (
    accounts,
    artefacts,
    checkpoints,
    events,
    heads,
    invitations,
    jobs,
    runs,
    sessions,
)
from service.store.database.wal import wal_findings
from service.store.durable_effects import DurableFiles
from service.store.errors import UnknownRunError
from service.store.events import read_events
from service.store.files.artefacts import TEMPORARY, hash_file, read_artefacts, relative_path
from service.store.records import SITE, Artefact, Checkpoint, RunRow, Timestamp
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.log import log_findings, read_log
from service.store.signatures.log_copy import copy_faults
from service.store.signatures.timestamps import timestamp_findings
from service.store.store import read_runs
from service.store.verification import chain_checks as checks
from service.store.verification import derived_checks as derived
from service.store.verification import signature_checks as signatures
from service.store.verification.chain_checks import ChainFacts, Fault, FileState
from service.store.verification.people_checks import people_faults
from service.store.verification.search_checks import word_faults

Progress = Callable[[str, int, int], None]  # (activity, bytes done, bytes in total)


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What was checked and what is wrong. `ok` means no faults; notes are not faults.

    The site's chain is always checked too, because it holds the keys; the counts are of `runs` only.
    """

    data_dir: str
    runs: tuple[str, ...]  # the runs asked for
    heads: Mapping[str, str]  # run → SHA-256 of its last event, to compare with one written down elsewhere
    events: int
    artefacts: int
    files: int
    bytes_hashed: int
    jobs: int
    checkpoints: int
    timestamps: int
    unsigned_events: Mapping[str, int]  # run → events after its last checkpoint
    key_ids: tuple[str, ...]  # fingerprints of the site's keys, oldest first, to compare as well
    faults: tuple[Fault, ...]  # in the order of the chain
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the evidence verifies."""
        return not self.faults

    @property
    def first_fault(self) -> Fault | None:
        """The first fault in the order of the chain, or None."""
        return self.faults[0] if self.faults else None


@dataclass(frozen=True, slots=True)
class EvidenceRecord:
    """One event of a run with its artefacts, for people to read."""

    seq: int
    at_utc: str
    monotonic_s: float
    actor: str
    kind: str
    summary: str
    sha256: str
    artefacts: tuple[Artefact, ...]


def verify(
    data_dir: Path,
    run_id: str | None = None,
    progress: Progress | None = None,
    *,
    certificates: Path | None = None,
    files: bool = True,
    signatures_copy: Path | None = None,
) -> AuditReport:
    """Check the chain, hash every file again and check every signature, of one run or of all.

    A chain that was rewritten up to its end, hashes included, is found by its checkpoints, whose key an intruder does
    not have. Events after the last checkpoint are reported in a note; only `heads` covers them.

    Args:
        data_dir: the data folder.
        run_id: one run, or None for all.
        progress: called with the number of bytes hashed.
        certificates: PEM file of the time-stamp authorities. Without it, only the stamped content is checked.
        files: False skips the files; a note says so.
        signatures_copy: a copy of the log of signatures, kept elsewhere, which shows whether the log was cut.

    Raises:
        UnknownRunError: there is no such run.
        StoreError: there is no database, or it cannot be read.
    """
    of_wal, notes_of_wal = wal_findings(data_dir)
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            report = _verify_readable(data_dir, connection, run_id, progress, certificates, with_files=files)
    finally:
        database.close()
    report = replace(report, faults=(*report.faults, *of_wal), notes=(*report.notes, *notes_of_wal))
    if signatures_copy is None:
        return report
    faults, notes = copy_faults(data_dir, signatures_copy)
    return replace(report, faults=(*report.faults, *faults), notes=(*report.notes, *notes))


def _verify_readable(
    data_dir: Path,
    connection: Connection,
    run_id: str | None,
    progress: Progress | None,
    certificates: Path | None,
    *,
    with_files: bool,
) -> AuditReport:
    """Verify; raises StoreError if the check fails on rows that only a damaged database can hold."""
    try:
        return _verify(data_dir, connection, run_id, progress, certificates, with_files=with_files)
    except (TypeError, ValueError, LookupError, ArithmeticError) as error:
        damage = _damage(connection)
        if not damage:
            raise
        raise StoreError(damage[0], where=str(database_path(data_dir)), remedy=RESTORE) from error


def _damage(connection: Connection) -> tuple[str, ...]:
    found = connection.execute(text("PRAGMA integrity_check(5)")).scalars()
    return tuple(f"SQLite finds the database damaged: {line}" for line in found if line != "ok")


def _verify(
    data_dir: Path,
    connection: Connection,
    run_id: str | None,
    progress: Progress | None,
    certificates: Path | None,
    *,
    with_files: bool,
) -> AuditReport:
    evidence = _read(connection, run_id)
    folder = data_dir / "artefacts"
    files, hashed = _hash_files(folder, evidence, progress) if with_files else (None, 0)
    chains = {SITE: ChainFacts()} | {run: ChainFacts() for run in evidence.run_ids}
    found: dict[str, list[Fault]] = {run: [] for run in chains}
    for run, facts in chains.items():
        if run == SITE and not evidence.has_site:
            continue
        found[run] += checks.run_faults(
            run,
            run_rows=evidence.runs.get(run, []),
            head_rows=evidence.heads.get(run, []),
            event_rows=_stream(connection, run),
            artefact_rows=evidence.artefacts.get(run, []),
            job_rows=evidence.jobs.get(run, []),
            files=files,
            facts=facts,
        )
    site = chains[SITE]
    keys = signatures.key_history(site, evidence.checkpoints[SITE])
    found[SITE] += keys.faults
    notes = list(keys.notes)
    unsigned: dict[str, int] = {}
    stamps = 0
    kept = list(signatures.stamp_faults(site, evidence.checkpoints, evidence.timestamps))
    for run, facts in chains.items():
        signed = evidence.checkpoints[run]
        rows = evidence.artefacts.get(run, [])
        found[run] += signatures.checkpoint_faults(run, signed, facts, site, keys.periods, rows)
        found[run] += signatures.start_faults(run, facts, site)
        found[run] += signatures.unsigned_end_faults(run, signed, facts)
        faults, said = timestamp_findings(signed, evidence.timestamps[run], certificates)
        found[run] += faults
        found[run] += [fault for fault in kept if fault.run_id == run and not faults]
        count, note = signatures.unsigned(run, signed, len(facts.sha256_at))
        notes += [*said, *([note] if note else [])]
        if run in evidence.run_ids:
            unsigned[run] = count
            stamps += len(evidence.timestamps[run])
    orphans, foreign = _unlisted(folder, evidence.every_sha256) if with_files else ([], [])
    if not with_files:
        notes.append("the files were not read again: only records and signatures were checked")
    public_keys = {key_id: period.public_key for key_id, period in keys.periods.items()}
    of_log, said_of_log = log_findings(
        read_log(data_dir / LOG_NAME), evidence.checkpoints, public_keys, awaited=bool(site.key_changes)
    )
    notes += said_of_log
    ordered = [*evidence.run_ids, *([] if SITE in evidence.run_ids else [SITE])]
    faults = [Fault(None, None, DATABASE_NAME, problem) for problem in evidence.damage]
    faults += [fault for run in ordered for fault in found[run]]
    faults += signatures.signed_run_faults(site, chains, every_run=run_id is None)
    faults += of_log
    faults += foreign
    faults += derived.schema_faults(connection)
    faults += derived.reference_faults(connection)
    faults += derived.index_faults(connection, ordered, every_run=run_id is None)
    faults += derived.queue_faults(connection, ordered)
    faults += word_faults(connection, ordered)
    faults += people_faults(site.people, evidence.accounts, evidence.links, evidence.sessions)
    return AuditReport(
        data_dir=str(data_dir),
        runs=evidence.run_ids,
        heads={row["run_id"]: row["sha256"] for heads in evidence.heads.values() for row in heads},
        events=sum(len(chains[run].sha256_at) for run in evidence.run_ids),
        artefacts=sum(len(evidence.artefacts.get(run, [])) for run in evidence.run_ids),
        files=len(files or {}),
        bytes_hashed=hashed,
        jobs=sum(len(evidence.jobs.get(run, [])) for run in evidence.run_ids),
        checkpoints=sum(len(evidence.checkpoints[run]) for run in evidence.run_ids),
        timestamps=stamps,
        unsigned_events=unsigned,
        key_ids=tuple(keys.periods),
        faults=tuple(faults),
        notes=(*notes, *orphans),
    )


def show(data_dir: Path, run_id: str) -> list[EvidenceRecord]:
    """The events of a run, oldest first. Raises UnknownRunError, StoreError."""
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            if run_id not in {run.run_id for run in read_runs(connection)}:
                raise UnknownRunError(f"there is no run {run_id!r}", where=str(database_path(data_dir)))
            recorded = read_events(connection, run_id, 0)
            brought: dict[int, list[Artefact]] = {}
            for artefact in read_artefacts(connection, run_id):
                brought.setdefault(artefact.seq, []).append(artefact)
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
            artefacts=tuple(brought.get(event.seq, ())),
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


_Rows = dict[str, list[dict[str, Any]]]  # by run


@dataclass(frozen=True, slots=True)
class _Evidence:
    """All rows other than the events, which may be many and are streamed instead."""

    run_ids: tuple[str, ...]
    has_site: bool
    runs: _Rows
    heads: _Rows
    artefacts: _Rows
    jobs: _Rows
    checkpoints: Mapping[str, list[Checkpoint]]
    timestamps: Mapping[str, list[Timestamp]]
    every_sha256: frozenset[str]
    accounts: Sequence[Mapping[str, Any]]
    links: Sequence[Mapping[str, Any]]
    sessions: Sequence[Mapping[str, Any]]
    damage: tuple[str, ...]


def _read(connection: Connection, run_id: str | None) -> _Evidence:
    damage = _damage(connection)
    known = set(connection.execute(select(runs.c.run_id)).scalars())
    # A run whose row was deleted may still have events or checkpoints.
    known |= set(connection.execute(select(events.c.run_id).distinct()).scalars())
    known |= set(connection.execute(select(checkpoints.c.run_id).distinct()).scalars())
    if run_id is not None and run_id not in known:
        raise UnknownRunError(
            f"there is no run {run_id!r}",
            where=str(connection.engine.url.database),
            remedy="List the runs with `orthocapture status`",
        )
    chosen = tuple(sorted(known)) if run_id is None else (run_id,)
    read = tuple({*chosen, SITE})

    def rows(table: Table, *order: Any) -> _Rows:
        grouped: _Rows = {}
        statement = select(table).where(table.c.run_id.in_(read)) if run_id is not None else select(table)
        for row in connection.execute(statement.order_by(*order)).mappings():
            grouped.setdefault(str(row["run_id"]), []).append(dict(row))
        return grouped

    def all_of(table: Table) -> list[dict[str, Any]]:
        return [dict(row) for row in connection.execute(select(table)).mappings()]

    return _Evidence(
        run_ids=chosen,
        has_site=SITE in known,
        runs=rows(runs),
        heads=rows(heads),
        artefacts=rows(artefacts, artefacts.c.run_id, artefacts.c.seq, artefacts.c.position),
        jobs=rows(jobs, jobs.c.position),
        checkpoints={run: read_checkpoints(connection, run) for run in read},
        timestamps={run: read_timestamps(connection, run) for run in read},
        every_sha256=frozenset(connection.execute(select(artefacts.c.sha256)).scalars()),
        accounts=all_of(accounts),
        links=all_of(invitations),
        sessions=all_of(sessions),
        damage=damage,
    )


def _stream(connection: Connection, run_id: str) -> Iterator[Mapping[Any, Any]]:
    statement = select(events).where(events.c.run_id == run_id).order_by(events.c.seq)
    return iter(connection.execution_options(yield_per=500).execute(statement).mappings())


def _hash_files(folder: Path, evidence: _Evidence, progress: Progress | None) -> tuple[dict[str, FileState], int]:
    wanted = {row["sha256"]: int(row["size_bytes"]) for rows in evidence.artefacts.values() for row in rows}
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
    """(notes, faults) on files that no row names. Leftovers of crashes are notes: partial and unrecorded files."""
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
