"""What a write transaction changes in the tables that the journal keeps, found by the database itself.

Temporary triggers of the writing connection note the key of every row that is inserted, changed or deleted, whatever
statement does it. Before the commit, the rows with these keys are read once more.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence

from service.store.database.tables import metadata
from service.store.journal.lines import RowImage, Value

# The record: whoever adds a table says whether the journal keeps it.
KEPT = ("runs", "events", "artefacts", "jobs", "checkpoints", "timestamps", "accounts", "invitations")
DERIVED = ("event_index", "event_facets", "heads")  # made again from the events
PRESENT_STATE = ("leases", "sessions", "control")  # of processes and screens of the moment
STATED_ELSEWHERE = ("copies",)  # by the place itself, which is asked again
_KEYS = {name: tuple(column.name for column in metadata.tables[name].primary_key.columns) for name in KEPT}
_COLUMNS = {name: tuple(column.name for column in metadata.tables[name].columns) for name in KEPT}
_MOST_KEYS = max(map(len, _KEYS.values()))
_ORDER = {"events": "(SELECT position FROM event_index AS i WHERE i.run_id = t.run_id AND i.seq = t.seq)"}
# Which worker computes a job is of the moment; that it waits again, or has ended, is of the record.
_WHEN = {"jobs": "WHEN NEW.state <> 'running'"}
_TOUCHED = "journal_touched"


def watch(connection: sqlite3.Connection) -> bool:
    """Make the triggers of a connection that is in no transaction. False if the tables do not exist yet."""
    found = connection.execute("SELECT name FROM main.sqlite_master WHERE type = 'table'")
    if not {row[0] for row in found} >= set(KEPT):
        return False
    keys = ", ".join(f"k{index}" for index in range(_MOST_KEYS))
    connection.execute(f"CREATE TEMP TABLE {_TOUCHED} (name, {keys})")
    for name in KEPT:
        for verb, rows in (("INSERT", ("NEW",)), ("UPDATE", ("OLD", "NEW")), ("DELETE", ("OLD",))):
            condition = _WHEN.get(name, "") if verb == "UPDATE" else ""
            notes = "".join(f"INSERT INTO {_TOUCHED} VALUES ('{name}', {_key(name, row)}); " for row in rows)
            connection.execute(
                f"CREATE TEMP TRIGGER journal_{verb.lower()}_{name} AFTER {verb} ON main.{name} {condition} "
                f"BEGIN {notes}END"
            )
    return True


def _key(name: str, row: str) -> str:
    columns = [f"{row}.{column}" for column in _KEYS[name]]
    return ", ".join(columns + ["NULL"] * (_MOST_KEYS - len(columns)))


def forget(connection: sqlite3.Connection) -> None:
    """Forget what earlier transactions of this connection have changed."""
    connection.execute(f"DELETE FROM {_TOUCHED}")


def changed_rows(connection: sqlite3.Connection) -> list[RowImage]:
    """Return the rows that the present transaction has changed, as they are now, in order of their first change."""
    keys = ", ".join(f"k{index}" for index in range(_MOST_KEYS))
    asked = f"SELECT name, {keys} FROM {_TOUCHED} GROUP BY name, {keys} ORDER BY min(rowid)"
    images: list[RowImage] = []
    for name, *key in connection.execute(asked).fetchall():
        columns = _KEYS[name]
        values = key[: len(columns)]
        where = " AND ".join(f"{column} = ?" for column in columns)
        row = connection.execute(f"SELECT {', '.join(_COLUMNS[name])} FROM {name} WHERE {where}", values).fetchone()
        images.append(
            RowImage(name, dict(zip(columns, values, strict=True)), True) if row is None else _image(name, row)
        )
    return images


def every_row(connection: sqlite3.Connection) -> Iterator[RowImage]:
    """Yield all rows that the journal keeps, events in the order in which they were written."""
    for name in KEPT:
        columns = ", ".join(f"t.{column}" for column in _COLUMNS[name])
        order = _ORDER.get(name, ", ".join(_KEYS[name]))
        for row in connection.execute(f"SELECT {columns} FROM {name} AS t ORDER BY {order}"):
            yield _image(name, row)


def _image(name: str, row: Sequence[Value]) -> RowImage:
    return RowImage(name, dict(zip(_COLUMNS[name], row, strict=True)))


def is_known(row: RowImage) -> bool:
    """Return whether the journal keeps this table, and the row has its key and no foreign column."""
    columns = _COLUMNS.get(row.table, ())
    return set(_KEYS.get(row.table, ("",))) <= row.values.keys() <= set(columns)


def key_of(row: RowImage) -> tuple[str, tuple[Value, ...]]:
    """Return the table and the primary key of a row. Raises KeyError for a table that the journal does not keep."""
    return row.table, tuple(row.values[column] for column in _KEYS[row.table])


def row_of_key(table: str, key: Sequence[Value]) -> RowImage:
    """Return a row of which only the key is known."""
    return RowImage(table, dict(zip(_KEYS[table], key, strict=True)))


def apply(connection: sqlite3.Connection, row: RowImage) -> None:
    """Bring a known row of another database to what it is in the journal. Raises sqlite3.Error if it is refused."""
    key = _KEYS[row.table]
    if row.gone:
        where = " AND ".join(f"{column} = ?" for column in key)
        connection.execute(f"DELETE FROM {row.table} WHERE {where}", [row.values[column] for column in key])
        return
    columns = list(row.values)  # an older line may have fewer than the table
    marks = ", ".join("?" for _ in columns)
    values = [row.values[column] for column in columns]
    connection.execute(f"INSERT OR REPLACE INTO {row.table} ({', '.join(columns)}) VALUES ({marks})", values)
