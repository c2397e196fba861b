"""Copies the record of a site between data folders, and moves one run, from SQLite to PostgreSQL or back.

The chain of a run lives in one database at a time. First the site's chain of the source says that the run goes on
elsewhere; from then on nothing is appended to it there. Then the target gets the rest of the run, in one
transaction with the event that says where it came from. Whoever is interrupted repeats the command.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, RowMapping, Select, Table, delete, func, insert, select, update

from service.core.errors import IntegrityError, StoreError
from service.core.records.events import RecordCopied, RunMoved, RunReceived, SignerNamed
from service.store.artefacts import ArtefactFiles, chunks_of
from service.store.backup import copy_keys, folder_errors
from service.store.data_folder import KEYS
from service.store.database.opening import open_read_only
from service.store.database.tables import (
    accounts,
    artefacts,
    checkpoints,
    event_index,
    events,
    heads,
    invitations,
    jobs,
    runs,
    timestamps,
)
from service.store.durable_effects import DurableFiles, Files, RandomIds
from service.store.event_index import EventToIndex, index_events, plain_payload
from service.store.events import canonical, moved_to, read_head, sha256_text
from service.store.objects.reading import SpoolReader
from service.store.records import SITE, NewArtefact
from service.store.runs import defer_references, is_held
from service.store.signatures.checkpoints import read_key_changes
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.signing import checkpoint, named_signer, this_signer
from service.store.store import Store

_AT_ONCE = 500  # rows
_TABLES = (heads, artefacts, checkpoints, timestamps, accounts, invitations, jobs)
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class CopyReport:
    """The result of a copy."""

    recorded: RecordCopied
    missing: tuple[str, ...]  # files that the source lacks, or has with other content


def copy_record(
    source: Path,
    target: Path,
    *,
    actor: Callable[[Path], str],
    progress: Progress | None = None,
    files: Files | None = None,
) -> CopyReport:
    """Copy all chains, files, accounts, keys and signatures of a data folder into one that has none.

    The numbers and texts of every row, and so all hashes, are the same afterwards. Leases, sign-ins and who is in
    control are of the moment and stay behind. The copy is recorded in the site's chain of the target, and signed.

    Args:
        source: the data folder to copy; it is only read. No run may be going on in it.
        target: the data folder to copy to: new, empty but for a site.yaml, or with a prepared, empty database.
        actor: gives the name of the person for the record, or raises; called with the source.
        progress: a function that is called with the number of bytes of files copied.
        files: durable file operations.

    Raises:
        StoreError: the target has a record already, or one of the two cannot be used. Of the chains nothing was
            copied; files that were are used when this is repeated.
    """
    files = files or DurableFiles()
    who = actor(source)
    _require_new(target)
    origin = open_read_only(source, files)
    try:
        with origin.reading() as reading, Store.open(target, files=files) as store:
            _require_no_record(store)
            every = select(artefacts.c.sha256, artefacts.c.size_bytes)
            missing, copied = copy_artefacts(reading, every, source, store, progress)
            with store.database.writing() as writing:
                number = _copy_rows(reading, writing)
                ends = _require_equal_ends(reading, writing)
            with folder_errors("keys and signatures could not be copied"):
                _copy_keys(source, target, files)
            recorded = RecordCopied(
                source=str(source.resolve()),
                database=store.database.where,
                runs=number[runs.name] - (SITE in ends),
                events=number[events.name],
                files=copied,
                heads_sha256=sha256_text(canonical(ends)),
            )
    finally:
        origin.close()
    with Store.open(target, files=files, create=False) as store:  # with the keys that are there now
        store.record_site([recorded, *_signer(store)], actor=who)
        checkpoint(store, SITE)
    return CopyReport(recorded, tuple(missing))


def _signer(store: Store) -> list[SignerNamed]:
    """Return the event by which the copy signs, if its chain names the folder that signed the source."""
    with store.database.reading() as connection:
        if named_signer(connection) is None:
            return []
        key_id = str(read_key_changes(connection)[-1][1]["key_id"])
    return [this_signer(store.database_path.parent, key_id)]


def _require_new(target: Path) -> None:
    there = [name for name in (KEYS, LOG_NAME) if (target / name).exists()]
    if there:
        raise StoreError(
            f"the target has {' and '.join(there)} already",
            where=str(target),
            remedy="Name a new folder, or one that has nothing but a site.yaml",
        )


def _require_no_record(store: Store) -> None:
    with store.database.reading() as connection:
        known = connection.execute(select(runs.c.run_id).limit(1)).scalar()
    if known is not None:
        raise StoreError(
            f"the target has a record already: {known}",
            where=store.database.where,
            remedy="Copy into an empty database; two records are never mixed",
        )


def copy_artefacts(
    reading: Connection, chosen: Select[Any, Any], source: Path, store: Store, progress: Progress | None
) -> tuple[list[str], int]:
    """Copy the chosen files of a record; return those that the source does not have, and the number copied.

    Args:
        reading: a connection to the source's database.
        chosen: a query of artefacts.sha256 and artefacts.size_bytes.
        source: the data folder to copy from.
        store: the store to copy to.
        progress: a function that is called with the number of bytes copied.
    """
    origin = SpoolReader(source, ArtefactFiles(source / "artefacts", DurableFiles(), RandomIds()))
    named = chosen.distinct().order_by(artefacts.c.sha256)
    sizes = {row.sha256: int(row.size_bytes) for row in reading.execute(named)}
    missing: list[str] = []
    done = 0
    for sha256, size in sizes.items():
        try:
            path = origin.path(sha256, verify=True)
        except IntegrityError as error:
            missing.append(f"{error.where}: {error.what}")
        else:
            store.put_file(path, kind="copy", media_type="application/octet-stream", sha256=sha256)
        done += size
        if progress is not None:
            progress("copying files", done, sum(sizes.values()))
    return missing, len(sizes) - len(missing)


def _copy_keys(source: Path, target: Path, files: Files) -> None:
    if (source / LOG_NAME).is_file():
        files.write(target / LOG_NAME, chunks_of(source / LOG_NAME))
        files.sync_file(target / LOG_NAME)
    if (source / KEYS).is_dir():
        copy_keys(source / KEYS, target / KEYS, files)
    files.sync_directory(target)


def _copy_rows(reading: Connection, writing: Connection) -> Counter[str]:
    """Copy all rows of the record; returns their number by table. The index of events is derived again."""
    defer_references(writing)
    counted: Counter[str] = Counter()
    _copy_table(reading, writing, runs, counted)
    place = (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq)
    for chunk in copied_rows(reading, select(events).join(event_index, place).order_by(event_index.c.position)):
        writing.execute(insert(events), [dict(row) for row in chunk])
        index_events(writing, [to_index(row) for row in chunk])
        counted[events.name] += len(chunk)
    for table in _TABLES:
        _copy_table(reading, writing, table, counted)
    return counted


def to_index(row: RowMapping) -> EventToIndex:
    """Return a row of events as what the index is made from."""
    return EventToIndex(row["run_id"], row["seq"], row["kind"], row["actor"], plain_payload(row["payload"]))


def _copy_table(reading: Connection, writing: Connection, table: Table, counted: Counter[str]) -> None:
    order = [table.c.at_utc] if table is checkpoints else []  # the order in which they were made
    for chunk in copied_rows(reading, select(table).order_by(*order, *table.primary_key.columns)):
        writing.execute(insert(table), [dict(row) for row in chunk])
        counted[table.name] += len(chunk)


def copied_rows(connection: Connection, statement: Any) -> Iterator[Sequence[RowMapping]]:
    """Yield the rows of a statement as plain values, some at a time."""
    with connection.execution_options(yield_per=_AT_ONCE).execute(statement) as rows:
        for chunk in rows.mappings().partitions(_AT_ONCE):
            yield list(chunk)


def _require_equal_ends(reading: Connection, writing: Connection) -> dict[str, str]:
    """Return the last hash of each chain. Raises StoreError unless they and the number of events are equal."""
    ends = select(heads.c.run_id, heads.c.sha256).order_by(heads.c.run_id)
    number = select(func.count()).select_from(events)
    there, here = ({str(run): str(sha256) for run, sha256 in c.execute(ends)} for c in (reading, writing))
    if there != here or reading.execute(number).scalar_one() != writing.execute(number).scalar_one():
        raise StoreError(
            "the chains of the copy do not end as those of the source; nothing of them was copied",
            remedy="Run `orthocapture audit verify all` on the source",
        )
    return here


_RESTED_ON = ("key_changed", "account_changed", "protocol_approved")  # events of the site's chain


@dataclass(frozen=True, slots=True)
class MoveReport:
    """The result of a move."""

    run_id: str
    moved: RunMoved
    received: RunReceived | None  # None: the target had it already, from an earlier try


def move_run(
    source: Path, target: Path, run: str, *, actor: Callable[[Path], str], progress: Progress | None = None
) -> MoveReport:
    """Move one run with its files and jobs; heads and every number are the same in both records afterwards.

    Each record says so in its site's chain. The source keeps the events and the files, and refuses to append to the
    run. The target signs the run with its own key; a file there holds the signatures of the source.

    Args:
        source: the data folder in which the run goes on now.
        target: the data folder in which it goes on afterwards; it may have other runs.
        run: the run's name, an unambiguous beginning, or `latest`.
        actor: gives the name of the person for both records, or raises; called with the source.
        progress: a function that is called with the number of bytes of files copied.

    Raises:
        UnknownRunError: the source has no such run.
        IntegrityError: a file of the run is missing or altered, or its chain does not verify.
        StoreError: somebody drives the run, a job of it is being computed, it has been moved elsewhere, or the target
            has a run of this name that did not come from here. Nothing was moved.
    """
    who = actor(source)
    with Store.open(source, create=False) as here, Store.open(target) as there:
        run_id = here.find_run(run)
        if here.database.where == there.database.where:
            raise StoreError("both folders have the same record: the run is there already", where=here.database.where)
        _require_fits(here, there, run_id)
        _copy_files(here, there, source, run_id, progress)
        moved = _release(here, there, run_id, who, target)
        checkpoint(here, run_id)
        checkpoint(here, SITE)
        _copy_files(here, there, source, run_id, progress)  # what came between
        received = _receive(here, there, run_id, who, source)
        checkpoint(there, run_id)
    return MoveReport(run_id, moved, received)


def _require_fits(here: Store, there: Store, run_id: str) -> None:
    """Raise StoreError unless the target has no such run, or has its beginning and has moved it away."""
    with here.database.reading() as reading, there.database.reading() as other:
        _require_beginning(reading, other, run_id, there.database.where)


def _require_beginning(reading: Connection, other: Connection, run_id: str, where: str) -> int:
    """Return the number of events of the run that the target has; 0 if it has none. Raises StoreError."""
    if other.execute(select(runs.c.run_id).where(runs.c.run_id == run_id)).first() is None:
        return 0
    seq, sha256 = read_head(other, run_id)
    same = select(events.c.seq).where(events.c.run_id == run_id, events.c.seq == seq, events.c.sha256 == sha256)
    if reading.execute(same).first() is None:
        raise StoreError(
            f"the target has a run {run_id} that does not go on as this one does",
            where=where,
            remedy="Run `orthocapture audit verify all` on both; two chains are never mixed",
        )
    if moved_to(other, run_id) is None and seq != read_head(reading, run_id)[0]:
        raise StoreError("the run goes on in the target already", where=where)
    return seq


def _release(here: Store, there: Store, run_id: str, who: str, target: Path) -> RunMoved:
    """Record in the source that the run goes on in the target, unless that is recorded. Raises StoreError."""
    with here.database.writing() as connection:
        before = moved_to(connection, run_id)
        if before is not None:
            if before.database == there.database.where:
                return before  # that was interrupted
            raise StoreError(
                f"this run was moved before and goes on in {before.database}",
                where=f"run {run_id}",
                remedy=f"Move it from there: orthocapture store copy {before.target} TO --run {run_id}",
            )
        if is_held(connection, here.clock, run_id):
            raise StoreError("a process drives this run", where=run_id, remedy="End it, then move the run")
        computed = select(jobs.c.job_id).where(jobs.c.run_id == run_id, jobs.c.state == "running")
        job = connection.execute(computed).scalar()
        if job is not None:
            raise StoreError(
                f"a job of this run is being computed: {job}",
                where=run_id,
                remedy="Wait for it, or end the worker; a worker that was killed loses the job when its lease ends",
            )
        seq, sha256 = read_head(connection, run_id)
        moved = RunMoved(
            moved_run=run_id,
            seq=seq,
            sha256=sha256,
            target=str(target.resolve()),
            database=there.database.where,
        )
        here.append_site(connection, [moved], actor=who)
    return moved


def _copy_files(here: Store, there: Store, source: Path, run_id: str, progress: Progress | None) -> None:
    named = select(artefacts.c.sha256, artefacts.c.size_bytes).where(artefacts.c.run_id == run_id)
    with here.database.reading() as connection:
        missing, _ = copy_artefacts(connection, named, source, there, progress)
    if missing:
        raise IntegrityError(
            f"{missing[0]}" + (f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""),
            where=f"run {run_id}",
            remedy="Restore it; a run is moved with all of its files or not at all",
        )


def _receive(here: Store, there: Store, run_id: str, who: str, source: Path) -> RunReceived | None:
    """Write what the target does not have of the run, with the event that says so; None if it had all of it."""
    with here.database.reading() as reading:
        signatures = _signatures(reading, run_id)
        text = json.dumps(signatures, indent=1, sort_keys=True).encode()
        ref = there.put_bytes(
            text, kind="signatures", media_type="application/json", original_name=f"signatures_{run_id}.json"
        )
        with there.database.writing() as writing:
            first = _require_beginning(reading, writing, run_id, there.database.where)
            if first and moved_to(writing, run_id) is None:
                return None  # an earlier try did this
            defer_references(writing)
            count = _copy_chain(reading, writing, run_id, first)
            _copy_jobs(reading, writing, run_id)
            seq, sha256 = read_head(writing, run_id)
            if (seq, sha256) != read_head(reading, run_id):
                raise StoreError("the copied chain does not end as that of the source; nothing was written")
            files = select(func.count(artefacts.c.sha256.distinct())).where(artefacts.c.run_id == run_id)
            received = RunReceived(
                moved_run=run_id,
                seq=seq,
                sha256=sha256,
                source=str(source.resolve()),
                database=here.database.where,
                events=count,
                files=writing.execute(files).scalar_one(),
                signatures=ref,
            )
            there.append_site(writing, [received], actor=who, artefacts=[NewArtefact(ref, "service")])
    return received


def _copy_chain(reading: Connection, writing: Connection, run_id: str, first: int) -> int:
    """Copy events after the first ones, with their artefact rows; returns the number of events."""
    if not first:
        row = reading.execute(select(runs).where(runs.c.run_id == run_id)).mappings().one()
        writing.execute(insert(runs), dict(row))
    count = 0
    chain = select(events).where(events.c.run_id == run_id, events.c.seq > first).order_by(events.c.seq)
    for chunk in copied_rows(reading, chain):
        writing.execute(insert(events), [dict(row) for row in chunk])
        index_events(writing, [to_index(row) for row in chunk])
        count += len(chunk)
    head = dict(reading.execute(select(heads).where(heads.c.run_id == run_id)).mappings().one())
    writing.execute(update(heads).where(heads.c.run_id == run_id).values(**head) if first else insert(heads), head)
    of_run = select(artefacts).where(artefacts.c.run_id == run_id, artefacts.c.seq > first)
    for chunk in copied_rows(reading, of_run.order_by(artefacts.c.seq, artefacts.c.position)):
        writing.execute(insert(artefacts), [dict(row) for row in chunk])
    return count


def _copy_jobs(reading: Connection, writing: Connection, run_id: str) -> None:
    """Copy the jobs in the order in which they were enqueued; those that the target has keep their places."""
    known = select(jobs.c.job_id, jobs.c.position).where(jobs.c.run_id == run_id)
    places: dict[str, int] = {str(job): int(place) for job, place in writing.execute(known)}
    next_place = int(writing.execute(select(func.coalesce(func.max(jobs.c.position), 0) + 1)).scalar_one())
    writing.execute(delete(jobs).where(jobs.c.run_id == run_id))
    for chunk in copied_rows(reading, select(jobs).where(jobs.c.run_id == run_id).order_by(jobs.c.enqueued_seq)):
        for row in chunk:
            if row["job_id"] not in places:
                places[row["job_id"]], next_place = next_place, next_place + 1
        writing.execute(insert(jobs), [{**row, "position": places[row["job_id"]]} for row in chunk])


def _signatures(reading: Connection, run_id: str) -> Mapping[str, Any]:
    """Return the source's signatures and time stamps of a run, and the events of its site on which they rest."""
    made = select(checkpoints).where(checkpoints.c.run_id == run_id).order_by(checkpoints.c.seq)
    stamped = select(timestamps).where(timestamps.c.run_id == run_id).order_by(timestamps.c.seq)
    rested = select(events).where(events.c.run_id == SITE, events.c.kind.in_(_RESTED_ON)).order_by(events.c.seq)
    return {
        "run": run_id,
        "checkpoints": _plain(reading, made),
        "timestamps": _plain(reading, stamped),
        "site_events": _plain(reading, rested),
    }


def _plain(reading: Connection, statement: Any) -> Sequence[dict[str, Any]]:
    return [dict(row) for chunk in copied_rows(reading, statement) for row in chunk]
