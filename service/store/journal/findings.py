"""Compare a database with its journal: what either of them lacks, has more, or has otherwise."""

from __future__ import annotations

import hashlib
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from sqlalchemy import Connection

from service.store.database.engine import DATABASE_NAME
from service.store.journal import changes
from service.store.journal.lines import NAME, RowImage, Value
from service.store.journal.survey import Survey, committed_rows, survey
from service.store.records import SITE
from service.store.verification.chain_checks import Fault

_MOST_OF_A_TABLE = 10  # faults of one table that are named one by one
_OF_A_WORKER = {"worker", "token", "until_utc_s", "host", "boot", "pid", "process_started_s"}
_OF_THE_MOMENT = {"state", "tries", "started_utc", "ended_utc", "ended_seq", "error", *_OF_A_WORKER}  # while it waits
_Key = tuple[str, tuple[Value, ...]]


def journal_findings(
    data_dir: Path, connection: Connection, run_ids: Sequence[str] | None, held_now: Callable[[], int]
) -> tuple[list[Fault], list[str]]:
    """Faults and notes on differences between a database and its journal.

    Args:
        data_dir: the data folder.
        connection: the snapshot that is verified.
        run_ids: the runs whose rows are compared, beside those of the site; None for all.
        held_now: reads the number of the line that the database holds by now, for a process may be writing.
    """
    raw = connection.connection.driver_connection
    assert isinstance(raw, sqlite3.Connection)  # the engine's own driver
    (held,) = raw.execute("PRAGMA user_version").fetchone()
    surveyed = survey(data_dir / NAME)
    if surveyed.is_behind(held_now()):
        surveyed = survey(data_dir / NAME)  # a line that was being withdrawn or written
    faults = [Fault(None, None, f"{NAME}, line {number}", what) for number, what in surveyed.problems]
    if surveyed.last == 0 and held:
        faults.append(Fault(None, None, NAME, f"the journal is missing or empty; the database holds its line {held}"))
        return faults, []
    if surveyed.last == 0 and not surveyed.problems:
        begun = raw.execute("SELECT 1 FROM events LIMIT 1").fetchone() is not None
        return [], [f"there is no {NAME} yet: the next write begins it"] if begun else []
    if surveyed.last < held:
        faults.append(Fault(None, None, NAME, f"it ends at line {surveyed.last}, the database holds line {held}"))
    elif surveyed.is_behind(now := held_now()):
        faults.append(Fault(None, None, DATABASE_NAME, _behind(surveyed, now)))
    if surveyed.problems:  # the rows of a damaged line would look as if they had been put into the database
        return faults, list(_notes(surveyed, held_now()))
    wanted = None if run_ids is None else {*run_ids, SITE}
    rows = committed_rows(data_dir / NAME, surveyed, held)
    return faults + list(_differences(raw, rows, wanted)), list(_notes(surveyed, held_now()))


def _behind(surveyed: Survey, held: int) -> str:
    return (
        f"it holds line {held} of {NAME}, which has {surveyed.last}: the database was overwritten, cut, or replaced "
        "by an older one; `orthocapture store rebuild` restores it"
    )


def _notes(surveyed: Survey, held: int) -> Iterator[str]:
    if surveyed.earlier_events:
        yield f"{NAME}: {surveyed.earlier_events} events were recorded before the journal was begun"
    if surveyed.torn_bytes:
        yield f"{NAME}: its end is cut off, as after a power cut"
    interrupted = len(surveyed.void) + (held == surveyed.before_last and not surveyed.is_behind(held))
    if interrupted:
        lines = "1 line was" if interrupted == 1 else f"{interrupted} lines were"
        yield f"{NAME}: {lines} never committed; the writer was interrupted"


def _differences(
    connection: sqlite3.Connection, rows: Iterator[RowImage], wanted: set[str] | None
) -> Iterator[Fault]:
    """Rows that the database lacks, has otherwise, or has beside the journal."""
    expected: dict[_Key, _Written] = {}
    for row in rows:
        if not _is_of(row, wanted):
            continue
        key = changes.key_of(row)
        if row.gone:
            expected.pop(key, None)
        else:
            expected[key] = _written(row)
    told: Counter[str] = Counter()
    for row in changes.every_row(connection):
        if not _is_of(row, wanted):
            continue
        written = expected.pop(changes.key_of(row), None)
        if written is None:
            yield from _fault(told, row, "is not in the journal: it was put into the database past it")
        elif written.digest != _digest(row, written.columns):
            yield from _fault(told, row, "is not as it is in the journal: it was altered")
    for key in expected:
        row = changes.row_of_key(*key)
        yield from _fault(told, row, "is in the journal and no longer in the database: it was removed")
    for table, number in told.items():
        if number > _MOST_OF_A_TABLE:
            more = number - _MOST_OF_A_TABLE
            yield Fault(None, None, DATABASE_NAME, f"{more} more rows of {table} are not as they are in the journal")


def _is_of(row: RowImage, wanted: set[str] | None) -> bool:
    return wanted is None or row.values.get("run_id", SITE) in wanted


@dataclass(frozen=True, slots=True)
class _Written:
    """What must still be as it was written: these columns of a row, of which there may be many, as a digest."""

    columns: tuple[str, ...]  # an older line may have fewer than the table
    digest: bytes


def _written(row: RowImage) -> _Written:
    waits = row.table == "jobs" and row.values["state"] not in ("finished", "failed")
    columns = _sorted(tuple(row.values), frozenset(_OF_THE_MOMENT) if waits else frozenset())
    return _Written(columns, _digest(row, columns))


@cache
def _sorted(columns: tuple[str, ...], without: frozenset[str]) -> tuple[str, ...]:
    return tuple(sorted(set(columns) - without))


def _digest(row: RowImage, columns: tuple[str, ...]) -> bytes:
    return hashlib.sha256(repr([row.values[column] for column in columns]).encode()).digest()


def _fault(told: Counter[str], row: RowImage, what: str) -> Iterator[Fault]:
    told[row.table] += 1
    if told[row.table] > _MOST_OF_A_TABLE:
        return
    run_id = row.values.get("run_id")
    seq = row.values.get("seq", row.values.get("enqueued_seq"))
    table = "" if run_id is not None else f"{DATABASE_NAME}, {row.table}"
    shown = "the event" if row.table == "events" else f"its row of {row.table}"
    yield Fault(
        None if run_id is None else str(run_id), seq if isinstance(seq, int) else None, table, f"{shown} {what}"
    )
