"""Verify the evidence in a data folder, and list a run's evidence. Everything is opened read-only."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Table, select, text

from service.core.errors import IntegrityError, StoreError
from service.store.artefacts import read_artefacts
from service.store.database.database import Database, is_postgres
from service.store.database.engine import DATABASE_NAME, RESTORE, database_path
from service.store.database.opening import open_read_only
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
from service.store.durable_effects import DurableFiles
from service.store.events import read_events
from service.store.objects.reading import files_elsewhere
from service.store.records import SITE, Artefact, Checkpoint, RunRow, Timestamp, UnknownRunError
from service.store.runs import read_runs
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.log import LogLine, log_findings, read_log, written_again_findings
from service.store.signatures.second_place import copy_faults
from service.store.signatures.signing import in_another_place, signer_elsewhere
from service.store.verification import chain_checks as checks
from service.store.verification import derived_checks, postgres_checks
from service.store.verification import signature_checks as signatures
from service.store.verification.anchor_checks import (
    AnchorCounts,
    AnchorFindings,
    ReadAnchors,
    RecordSide,
    UnreadAnchors,
    compare,
    lines_not_compared,
    not_compared,
    read_anchors,
)
from service.store.verification.chain_checks import ChainFacts, Fault, FileState
from service.store.verification.file_checks import (
    Elsewhere,
    Progress,
    elsewhere_notes,
    hash_files,
    journal_findings,
    unlisted_files,
    unread_files,
    wal_findings,
)
from service.store.verification.people_checks import people_faults

_Rows = dict[str, list[dict[str, Any]]]  # by run


@dataclass(frozen=True, slots=True)
class EvidenceRows:
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


def read_evidence(connection: Connection, run_id: str | None) -> EvidenceRows:
    """Return the rows of a run and of the site, or with None those of every run. Raises UnknownRunError."""
    damage = database_damage(connection)
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

    return EvidenceRows(
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


def database_damage(connection: Connection) -> tuple[str, ...]:
    """Return the messages of SQLite's own check of the database; empty if it is sound, or of a server."""
    if is_postgres(connection):
        return ()
    found = connection.execute(text("PRAGMA integrity_check(5)")).scalars()
    return tuple(f"SQLite finds the database damaged: {line}" for line in found if line != "ok")


def event_rows(connection: Connection, run_id: str) -> Iterator[Mapping[Any, Any]]:
    """Yield the events of a run in order, read a part at a time."""
    statement = select(events).where(events.c.run_id == run_id).order_by(events.c.seq)
    with connection.execution_options(yield_per=500).execute(statement) as rows:
        yield from rows.mappings()


@dataclass(frozen=True, slots=True)
class AuditReport:
    """A list of what was checked and of what is wrong. `ok` means no faults; notes are not faults.

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
    faults: tuple[Fault, ...]  # faults in the order of the chain
    notes: tuple[str, ...]
    anchors: AnchorCounts | None = None  # compared with the object store; None if the site has no anchors there
    not_compared: tuple[str, ...] = ()  # sentences on what could not be compared with it, which are notes as well
    not_judged: tuple[str, ...] = ()  # sentences on views whose pose cannot be compared with their joints, by run

    def with_limits(self) -> AuditReport:
        """Return the report with what could not be judged among its notes, unless it has faults."""
        return replace(self, notes=(*self.notes, *self.not_judged)) if self.ok else self

    @property
    def ok(self) -> bool:
        """True if nothing differs."""
        return not self.faults

    @property
    def verified(self) -> bool:
        """True if nothing differs, and everything that a verification compares could be compared."""
        return self.ok and not self.not_compared

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
    stated_hashes: bool = False,
    anchors_of: Path | None = None,
) -> AuditReport:
    """Check the chain, hash every file again and check every signature, of one run or of all.

    A chain that was rewritten up to its end, hashes included, is found by its checkpoints, whose key an intruder does
    not have. Events after the last checkpoint are reported in a note; only `heads` covers them.

    Args:
        data_dir: the data folder.
        run_id: one run, or None for all.
        progress: a function that is called with the number of bytes hashed.
        certificates: PEM file of the time-stamp authorities. Without it, only the stamped content is checked.
        files: False skips the files; a note says so.
        signatures_copy: a copy of the log of signatures from elsewhere, which shows whether the log was cut.
        stated_hashes: take the object store's own SHA-256 of files that only it has, instead of fetching them.
        anchors_of: a folder elsewhere whose site.yaml names the object store of the anchors; None for the data
            folder's own, which whoever forges the record can change.

    Raises:
        UnknownRunError: there is no such run.
        StoreError: there is no database, or it cannot be read.
    """
    of_wal, notes_of_wal = wal_findings(data_dir)  # of SQLite; a server has no such file here
    away = files_elsewhere(data_dir, stated_hashes=stated_hashes) if files else None
    # Before the log: a signature made meanwhile is in the log before it has an anchor.
    anchors = read_anchors(anchors_of or data_dir)
    database = open_read_only(data_dir, DurableFiles())
    try:
        # Before the database's snapshot: a signature made meanwhile is in the database first, and then in the log.
        lines = read_log(data_dir / LOG_NAME)
        with database.reading() as connection, _damage_named(data_dir, connection):
            outside = _Outside(lines, certificates, away, anchors)
            report = _verify(data_dir, connection, outside, run_id, progress, with_files=files)
            runs = None if run_id is None else [run_id]
            of_journal, notes_of_journal = (
                ([], [])
                if is_postgres(connection)
                else journal_findings(data_dir, connection, runs, lambda: _held_now(database))
            )
    finally:
        database.close()
    faults = (*report.faults, *of_wal, *of_journal)
    report = replace(report, faults=faults, notes=(*report.notes, *notes_of_wal, *notes_of_journal))
    if signatures_copy is None:
        return report
    of_copy, notes = copy_faults(data_dir, signatures_copy)
    return replace(report, faults=(*report.faults, *of_copy), notes=(*report.notes, *notes))


def _held_now(database: Database) -> int:
    """Return the number of the journal's line that the database holds by now."""
    with database.reading() as connection:
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())


@contextmanager
def _damage_named(data_dir: Path, connection: Connection) -> Generator[None]:
    """Raise StoreError, with the damage, if a check fails on rows that only a damaged database can hold."""
    try:
        yield
    except (TypeError, ValueError, LookupError, ArithmeticError) as error:
        damage = database_damage(connection)
        if not damage:
            raise
        raise StoreError(damage[0], where=str(database_path(data_dir)), remedy=RESTORE) from error


@dataclass(frozen=True, slots=True)
class _Outside:
    """The witnesses of a database: the log of signatures, certificates, and an object store's files and anchors."""

    lines: Sequence[LogLine] | None
    certificates: Path | None
    away: Elsewhere | None
    anchors: ReadAnchors | UnreadAnchors | None


def _verify(
    data_dir: Path,
    connection: Connection,
    outside: _Outside,
    run_id: str | None,
    progress: Progress | None,
    *,
    with_files: bool,
) -> AuditReport:
    evidence = read_evidence(connection, run_id)
    folder = data_dir / "artefacts"
    artefact_rows = (row for rows in evidence.artefacts.values() for row in rows)
    files = hash_files(folder, artefact_rows, progress, outside.away) if with_files else None
    chains, found = _check_chains(connection, evidence, files)
    site = chains[SITE]
    keys = signatures.key_history(site, evidence.checkpoints[SITE])
    found[SITE] += keys.faults
    stamps_differ = tuple(signatures.stamp_faults(site, evidence.checkpoints, evidence.timestamps))
    check = _SignatureCheck(evidence, site, keys.periods, stamps_differ, outside.certificates)
    notes = list(keys.notes)
    for run, facts in chains.items():
        faults, said = check.findings(run, facts)
        found[run] += faults
        notes += said
    orphans, foreign = unlisted_files(folder, evidence.every_sha256) if with_files else ([], [])
    if not with_files:
        notes.append("the files were not read again: only records and signatures were checked")
    notes += elsewhere_notes((files or {}).values())
    named = None
    if outside.lines is None:
        with suppress(IntegrityError):  # an event that was altered is a fault of its chain
            named = signer_elsewhere(connection, data_dir)
    elsewhere = ""
    if named is not None and in_another_place(named, data_dir):
        of_log: list[Fault] = []
        elsewhere = f"the log of signatures is in {named.folder} on {named.host}"
        said_of_log = [f"{elsewhere}: a verification there reads it"]
    else:
        of_log, said_of_log = _log_findings(outside.lines, evidence, site, keys, run_id)
    every_run = run_id is None
    anchored, unread = _anchor_findings(outside, elsewhere, chains, keys, evidence, every_run=every_run)
    unread = (*unread_files((files or {}).values()), *unread)
    ordered = [*evidence.run_ids, *([] if SITE in evidence.run_ids else [SITE])]
    faults = [
        *(Fault(None, None, DATABASE_NAME, problem) for problem in evidence.damage),
        *(fault for run in ordered for fault in found[run]),
        *signatures.signed_run_faults(site, chains, every_run=every_run),
        *of_log,
        *anchored.faults,
        *foreign,
        *_derived_faults(connection, ordered, every_run=every_run),
        *people_faults(site.people, evidence.accounts, evidence.links, evidence.sessions),
    ]
    counted = _counted(data_dir, evidence, chains, files or {})
    return replace(
        counted,
        key_ids=tuple(keys.periods),
        faults=tuple(faults),
        notes=(*notes, *said_of_log, *anchored.notes, *unread, *orphans),
        anchors=None if outside.anchors is None else anchored.counts,
        not_compared=unread,
        not_judged=tuple(f"{run}: {said}" for run in evidence.run_ids for said in chains[run].poses.not_judged()),
    )


def _log_findings(
    lines: Sequence[LogLine] | None,
    evidence: EvidenceRows,
    site: ChainFacts,
    keys: signatures.Keys,
    run_id: str | None,
) -> tuple[list[Fault], list[str]]:
    """Return faults and notes of the log of signatures that lies beside the database."""
    public_keys = {key_id: period.public_key for key_id, period in keys.periods.items()}
    faults, notes = log_findings(lines, evidence.checkpoints, public_keys, awaited=bool(site.key_changes))
    before, said = written_again_findings(site.written_again, run_id)
    return [*before, *faults], [*said, *notes]


def _anchor_findings(
    outside: _Outside,
    elsewhere: str,
    chains: Mapping[str, ChainFacts],
    keys: signatures.Keys,
    evidence: EvidenceRows,
    *,
    every_run: bool,
) -> tuple[AnchorFindings, tuple[str, ...]]:
    """Return what the anchors in the object store show, and sentences on what could not be compared with them.

    `elsewhere` says where the log of signatures is, if another data folder has it: then only chains are compared.
    """
    anchors, lines = outside.anchors, outside.lines or []
    if anchors is None:
        return AnchorFindings(), ()
    signed = sum(map(len, evidence.checkpoints.values())) if elsewhere else len(lines)
    if isinstance(anchors, UnreadAnchors):
        counts = AnchorCounts(lines_not_compared=signed, heads_not_compared=len(evidence.heads))
        said = not_compared(anchors.place, anchors.why, counts.lines_not_compared, counts.heads_not_compared)
        return AnchorFindings(counts=counts), (said,)
    public_keys = {key_id: period.public_key for key_id, period in keys.periods.items()}
    if not elsewhere:
        return compare(anchors, RecordSide(lines, chains, public_keys, every_run)), ()
    found = compare(anchors, RecordSide(None, chains, public_keys, every_run))
    found.counts = replace(found.counts, lines_not_compared=signed)
    return found, (lines_not_compared(anchors.place, elsewhere, signed),)


def _check_chains(
    connection: Connection, evidence: EvidenceRows, files: Mapping[str, FileState] | None
) -> tuple[dict[str, ChainFacts], dict[str, list[Fault]]]:
    """Return facts and faults of the site's chain and of each run's, by run; `files` None: they were not read."""
    chains = {SITE: ChainFacts()} | {run: ChainFacts() for run in evidence.run_ids}
    found: dict[str, list[Fault]] = {run: [] for run in chains}
    for run, facts in chains.items():
        if run != SITE or evidence.has_site:
            rows = checks.ChainRows(
                runs=evidence.runs.get(run, []),
                heads=evidence.heads.get(run, []),
                events=event_rows(connection, run),
                artefacts=evidence.artefacts.get(run, []),
                jobs=evidence.jobs.get(run, []),
            )
            found[run] += checks.run_faults(run, rows, files, facts)
    return chains, found


@dataclass(frozen=True, slots=True)
class _SignatureCheck:
    """The data against which the signatures and time stamps of every chain are checked."""

    evidence: EvidenceRows
    site: ChainFacts
    keys: Mapping[str, signatures.KeyPeriod]
    stamps_differ: Sequence[Fault]  # time stamps that differ from those recorded in the site's chain
    certificates: Path | None

    def findings(self, run: str, facts: ChainFacts) -> tuple[list[Fault], list[str]]:
        """Return faults and notes of one chain."""
        signed = self.evidence.checkpoints[run]
        rows = self.evidence.artefacts.get(run, [])
        from service.store.signatures.timestamps import (  # noqa: PLC0415 - X.509, which only a verification needs
            timestamp_findings,
        )

        stamped, notes = timestamp_findings(signed, self.evidence.timestamps[run], self.certificates)
        faults = [
            *signatures.checkpoint_faults(run, signed, facts, self.site, self.keys, rows),
            *signatures.start_faults(run, facts, self.site),
            *signatures.unsigned_end_faults(run, signed, facts),
            *stamped,
            *(fault for fault in self.stamps_differ if fault.run_id == run and not stamped),
        ]
        away, notes_of_poses = facts.poses.findings(run)
        faults += [Fault(run, view.seq, "", str(view)) for view in away]
        _, note = signatures.unsigned(run, signed, len(facts.sha256_at))
        return faults, [
            *notes,
            *facts.backwards_notes(run),
            *notes_of_poses,
            *signatures.late_signatures(run, signed, facts),
            *([note] if note else []),
        ]


def _derived_faults(connection: Connection, runs: Sequence[str], *, every_run: bool) -> Iterator[Fault]:
    """Yield faults of the schema and of what is derived from the events: references, indexes, queue, words."""
    postgres = is_postgres(connection)
    yield from (postgres_checks if postgres else derived_checks).schema_faults(connection)
    yield from (postgres_checks if postgres else derived_checks).reference_faults(connection)
    yield from derived_checks.index_faults(connection, runs, every_run=every_run)
    yield from derived_checks.queue_faults(connection, runs)
    yield from (postgres_checks if postgres else derived_checks).content_faults(connection, runs, every_run=every_run)


def _counted(
    data_dir: Path, evidence: EvidenceRows, chains: Mapping[str, ChainFacts], files: Mapping[str, FileState]
) -> AuditReport:
    """Return the figures of a report, without faults and notes."""
    events = {run: len(chains[run].sha256_at) for run in evidence.run_ids}
    signed = evidence.checkpoints
    return AuditReport(
        data_dir=str(data_dir),
        runs=evidence.run_ids,
        heads={row["run_id"]: row["sha256"] for heads in evidence.heads.values() for row in heads},
        events=sum(events.values()),
        artefacts=sum(len(evidence.artefacts.get(run, [])) for run in evidence.run_ids),
        files=len(files),
        bytes_hashed=sum(state.size for state in files.values() if state.how != "stated"),
        jobs=sum(len(evidence.jobs.get(run, [])) for run in evidence.run_ids),
        checkpoints=sum(len(signed[run]) for run in evidence.run_ids),
        timestamps=sum(len(evidence.timestamps[run]) for run in evidence.run_ids),
        unsigned_events={run: signatures.unsigned(run, signed[run], events[run])[0] for run in evidence.run_ids},
        key_ids=(),
        faults=(),
        notes=(),
    )


def show(data_dir: Path, run_id: str) -> list[EvidenceRecord]:
    """Return the events of a run, oldest first. Raises UnknownRunError, StoreError."""
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
    """Return all runs of a data folder, oldest first, read-only. Raises StoreError."""
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            return read_runs(connection)
    finally:
        database.close()
