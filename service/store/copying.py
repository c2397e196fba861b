"""Copy the record of a site between data folders, from SQLite to PostgreSQL or back; the chains keep their hashes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, RowMapping, Select, Table, func, insert, select

from service.core.errors import IntegrityError, StoreError
from service.core.records.events import RecordCopied, SignerNamed
from service.store.access import KEYS
from service.store.artefacts import ArtefactFiles, chunks_of
from service.store.backup.folder import copy_keys, folder_errors
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
from service.store.events import canonical, sha256_text
from service.store.objects.reading import SpoolReader
from service.store.records import SITE
from service.store.runs import defer_references
from service.store.signatures.checkpoints import read_key_changes
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.signer import named_signer, this_signer
from service.store.signatures.signing import checkpoint
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
