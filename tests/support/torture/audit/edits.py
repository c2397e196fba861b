"""Logical tampering: deletes, copies and renumbers every row, edits every column, and changes the schema."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from service.store.database.engine import database_path
from service.store.database.tables import metadata
from service.store.event_index import cut_words
from tests.support.torture.audit import outcome
from tests.support.torture.audit.outcome import verdict
from tests.support.torture.audit.record import Record, put_back
from tests.support.torture.audit.tally import Tallies, Tally

TABLES = (*metadata.tables, "alembic_version")


@dataclass(frozen=True, slots=True)
class Edit:
    """One change: the kind it is counted under, its name, the part of the record it affects, its SQL statements."""

    kind: str
    name: str
    code: str
    statements: tuple[tuple[str, tuple[Any, ...]], ...]


def edits(data: Path) -> Iterator[Edit]:
    """Yield every change for the record as it is."""
    with closing(sqlite3.connect(f"file:{database_path(data)}?mode=ro", uri=True)) as connection:
        connection.row_factory = sqlite3.Row
        for table in TABLES:
            columns = connection.execute(f'PRAGMA table_info("{table}")').fetchall()
            own = _own_columns(connection, table, columns)
            known = ", ".join(f"{name} AS {name}" for name in own)
            number = "rowid" if own == ["rowid"] else f"row_number() OVER (ORDER BY {', '.join(own)})"
            listed = f'SELECT {number} AS row_number, {known}, * FROM "{table}" ORDER BY row_number'
            yield from _of_rows(table, connection.execute(listed).fetchall(), columns, own)
        yield from _of_another_run(connection)
        yield from _of_words(connection)
        yield from _of_schema(connection)


def _own_columns(connection: sqlite3.Connection, table: str, columns: list[Any]) -> list[str]:
    """Columns by whose values a row is found: SQLite's row number, or the key of a table that has none."""
    (without_number,) = connection.execute("SELECT wr FROM pragma_table_list WHERE name = ?", (table,)).fetchone()
    return [str(column["name"]) for column in columns if column["pk"]] if without_number else ["rowid"]


def _of_rows(table: str, rows: list[Any], columns: list[Any], own: list[str]) -> Iterator[Edit]:
    of_key = [str(column["name"]) for column in columns if column["pk"]]
    names = [str(column["name"]) for column in columns]
    where = " AND ".join(f"{name} = ?" for name in own)
    for row in rows:
        place = f"{table}, row {row['row_number']}"
        this = tuple(row[name] for name in own)
        delete = f'DELETE FROM "{table}" WHERE {where}', this
        yield Edit("row deleted", place, f"{table} -row", (delete,))
        for column in columns:
            name = str(column["name"])
            for value in _other_values(row[name], str(column["type"]), nullable=not column["notnull"]):
                change = f'UPDATE "{table}" SET "{name}" = ? WHERE {where}', (value, *this)
                shown = f"{place}: {name} = {value!r}"[:120]
                yield Edit("column edited", shown, f"{table}.{name}", (change,))
        yield Edit("row inserted", f"a copy of {place}", f"{table} +row", (_copy(table, names, row, of_key),))
    for one, other in pairwise(rows):
        places = f"{table}, rows {one['row_number']} and {other['row_number']}"
        yield Edit(
            "rows exchanged",
            places,
            f"{table} order",
            tuple(_exchanged(table, names, own, of_key, one, other)),
        )
        for name in names:
            if one[name] != other[name] and name not in of_key:
                swap = tuple(
                    (f'UPDATE "{table}" SET "{name}" = ? WHERE {where}', (a[name], *(b[column] for column in own)))
                    for a, b in ((one, other), (other, one))
                )
                yield Edit("columns exchanged", f"{places}: {name}", f"{table}.{name}", swap)


def _other_values(value: Any, kind: str, *, nullable: bool) -> Iterator[Any]:
    """Other values for a column: slightly different, of another type, and null."""
    match value:
        case None:
            yield {"INTEGER": 1, "REAL": 1.5}.get(kind, "x")
            return
        case int():
            yield from (value + 1, -1)
        case float():
            yield from (value + 1e-6, value + 3600.0)
        case str():
            yield from (value + " ", value.swapcase(), "", "Eve")
            if value:
                yield value[:-1] + ("0" if value[-1] != "0" else "1")
        case _:
            yield b""
    if nullable:
        yield None


def _copy(table: str, names: list[str], row: Any, of_key: list[str]) -> tuple[str, tuple[Any, ...]]:
    """Statement that copies a row under another key: text keys get a letter appended, numbers the next free value."""
    values: list[Any] = []
    for name in names:
        value = row[name]
        if name in of_key or name in ("job_id", "screen", "sha256", "previous_sha256", "idempotency_key"):
            if isinstance(value, int):
                value += 1000
            elif name in ("sha256", "previous_sha256"):
                value = value[::-1]
            elif name != "run_id" or table in ("runs", "heads", "leases", "control"):
                value = f"{value}x"
        values.append(value)
    if "run_id" in names and "seq" in names and "seq" not in of_key and table != "heads":
        values[names.index("seq")] += 1000
    listed, marks = ", ".join(f'"{name}"' for name in names), ", ".join("?" for _ in names)
    return f'INSERT INTO "{table}" ({listed}) VALUES ({marks})', tuple(values)


def _exchanged(
    table: str, names: list[str], own: list[str], of_key: list[str], one: Any, other: Any
) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """Statements that swap the keys of two rows."""
    where = " AND ".join(f"{name} = ?" for name in own)
    for row in (one, other):
        yield f'DELETE FROM "{table}" WHERE {where}', tuple(row[name] for name in own)
    listed, marks = ", ".join(f'"{name}"' for name in names), ", ".join("?" for _ in names)
    for row, place in ((one, other), (other, one)):
        values = tuple(place[name] if name in of_key else row[name] for name in names)
        yield f'INSERT INTO "{table}" ({listed}) VALUES ({marks})', values


def _of_another_run(connection: sqlite3.Connection) -> Iterator[Edit]:
    """Changes that copy a run's unique rows to runs that have none."""
    for table in ("leases", "control"):
        columns = [str(row["name"]) for row in connection.execute(f"PRAGMA table_info({table})")]
        listed = ", ".join(name for name in columns if name != "run_id")
        without = f"SELECT run_id FROM runs WHERE run_id NOT IN (SELECT run_id FROM {table})"
        for (run_id,) in connection.execute(without).fetchall():
            insert = f"INSERT INTO {table} (run_id, {listed}) SELECT ?, {listed} FROM {table} LIMIT 1", (run_id,)
            yield Edit("row inserted", f"a row of {table} for {run_id}", f"{table} +row", (insert,))


def _of_words(connection: sqlite3.Connection) -> Iterator[Edit]:
    """Changes of the search index, which has no ordinary rows: words added or removed, emptied, tables altered."""
    insert = "INSERT INTO event_words (rowid, words) VALUES (?, ?)"
    delete = "INSERT INTO event_words (event_words, rowid, words) VALUES ('delete', ?, ?)"
    for place, actor in connection.execute("SELECT position, actor FROM event_index").fetchall():
        yield Edit("row inserted", f"words of event {place}", "event_words +row", ((insert, (place, "accept")),))
        words = " ".join(cut_words(actor))
        yield Edit("row deleted", f"the actor of event {place}", "event_words -row", ((delete, (place, words)),))
    yield Edit("row inserted", "words of no event", "event_words +row", ((insert, (9999, "accept")),))
    everything = "INSERT INTO event_words (event_words) VALUES ('delete-all')"
    yield Edit("row deleted", "every word", "event_words -row", ((everything, ()),))
    for table in ("event_words_data", "event_words_idx", "event_words_config"):
        yield Edit("row deleted", f"all of {table}", table, ((f"DELETE FROM {table}", ()),))


def _of_schema(connection: sqlite3.Connection) -> Iterator[Edit]:
    made = connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_master WHERE sql IS NOT NULL").fetchall()
    for kind, name, table, sql in made:
        if name.startswith("event_words_"):
            continue
        yield Edit("schema changed", f"{kind} {name} dropped", f"schema {kind}", ((f'DROP {kind} "{name}"', ()),))
        rewritten = "UPDATE sqlite_master SET sql = ? WHERE name = ?", (sql + " ", name)
        yield Edit("schema changed", f"{kind} {name} rewritten", f"schema {kind}", (_WRITABLE, rewritten))
        if kind == "trigger":
            event = next(verb for verb in ("UPDATE", "DELETE", "INSERT") if f" {verb} ON " in sql)
            time = "AFTER" if " AFTER " in sql else "BEFORE"
            idle = f'CREATE TRIGGER "{name}" {time} {event} ON "{table}" BEGIN SELECT 1; END'
            replaced = ((f'DROP TRIGGER "{name}"', ()), (idle, ()))
            yield Edit("schema changed", f"{name} does nothing", "schema trigger", replaced)
    for name, statement in (
        ("a foreign trigger", "CREATE TRIGGER forget AFTER INSERT ON events BEGIN SELECT 1; END"),
        ("a foreign table", "CREATE TABLE other (x)"),
        ("a view", "CREATE VIEW seen AS SELECT * FROM events"),
        ("a foreign index", "CREATE INDEX other ON events (kind)"),
        ("a column more", "ALTER TABLE runs ADD COLUMN note TEXT"),
        ("a table renamed", "ALTER TABLE leases RENAME TO leases_before"),
        ("a column renamed", "ALTER TABLE runs RENAME COLUMN created_utc TO made_utc"),
        ("user_version", "PRAGMA user_version = 7"),
        ("application_id", "PRAGMA application_id = 7"),
    ):
        yield Edit("schema changed", name, f"schema {name}", ((statement, ()),))


_WRITABLE = "PRAGMA writable_schema = ON", ()


class Edits:
    """All changes, numbered, so that a subset can be done."""

    name = "logical tampering"

    def __init__(self, record: Record) -> None:
        put_back(record)
        self._record = record
        self.all = list(edits(record.data))
        self.size = len(self.all)
        self._notes = outcome.audit.verify(record.data).notes
        before = outcome.content_of(record.data)
        if isinstance(before, str):
            raise TypeError(before)
        self._before = before

    def part(self, numbers: Sequence[int]) -> Tallies:
        """Make these changes one at a time; returns the tallies by kind."""
        tallies: Tallies = {}
        for number in numbers:
            edit = self.all[number]
            put_back(self._record)
            if not _apply(self._record.data, edit):
                continue
            tally = tallies.setdefault(edit.kind, Tally())
            found = verdict(self._record, self._notes)
            tally.count(found, edit.name, lambda edit=edit: self._codes(edit))
        return tallies

    def _codes(self, edit: Edit) -> set[str]:
        same = outcome.same_rows(self._before, outcome.content_of(self._record.data))
        return set() if same else {edit.code}


def _apply(data: Path, edit: Edit) -> bool:
    """Apply a change as somebody with full access to the file would.

    Returns False if the tables themselves refuse it.
    """
    with closing(sqlite3.connect(database_path(data), isolation_level=None)) as connection:
        of_schema = edit.kind == "schema changed"
        triggers: list[tuple[str, str]] = []
        if not of_schema:
            triggers = connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
        try:
            connection.execute("BEGIN")
            for name, _sql in triggers:
                connection.execute(f'DROP TRIGGER "{name}"')
            for statement, values in edit.statements:
                connection.execute(statement, values)
            for _name, sql in triggers:
                connection.execute(sql)
            connection.execute("COMMIT")
        except sqlite3.IntegrityError:
            return False
    return True
