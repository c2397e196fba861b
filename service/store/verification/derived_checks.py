"""Check what can be derived again: schema, references between rows, the event index, its words, the queue."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing

from sqlalchemy import Connection, text

from service.store.database.engine import DATABASE_NAME, fresh_schema, read_schema
from service.store.event_index import WORDS_TABLE, indexed_events, words_of
from service.store.verification.chain_checks import Fault

_PARTS = {"data": "id, block", "idx": "segid, term, pgno", "config": "k, v"}  # shadow tables of the index
_OTHER = """
SELECT DISTINCT doc FROM (SELECT * FROM (SELECT * FROM {0}_places EXCEPT SELECT * FROM {1}_places)
UNION ALL SELECT * FROM (SELECT * FROM {1}_places EXCEPT SELECT * FROM {0}_places)) ORDER BY doc
"""
_BOTH = ("present", "again")
INDEX_DIFFERS = "the index of events does not say what the event says"
_DAMAGED = "the index by which auditors search is damaged"


def content_faults(connection: Connection, run_ids: Sequence[str], *, every_run: bool) -> Iterator[Fault]:
    """Yield a fault for each event with other facets, and each that a search would not find or would find wrongly.

    All work is done on copies in a private database; the evidence is not opened for writing.
    """
    differing: list[tuple[str, int]] = []
    try:
        with closing(sqlite3.connect("")) as private:  # "": a temporary database, on disk once it is large
            _index_words(connection, private, differing)
            wrong, damage = _compared(connection, private)
    except sqlite3.Error as error:
        wrong, damage = [], f"{_DAMAGED}: {error}"
    wanted, placed = frozenset(run_ids), False
    yield from (Fault(run, seq, "", INDEX_DIFFERS) for run, seq in differing if run in wanted or every_run)
    for position in wrong:
        found = text("SELECT run_id, seq FROM event_index WHERE position = :position")
        row = connection.execute(found, {"position": position}).one_or_none()
        placed = True
        if row is None:
            what = f"the index by which auditors search has words of an event that is not there (place {position})"
            yield Fault(None, None, DATABASE_NAME, what)
        elif row.run_id in wanted:
            yield Fault(str(row.run_id), int(row.seq), "", "the words by which auditors search are not the event's")
    if damage and not placed:
        yield Fault(None, None, DATABASE_NAME, damage)


def _index_words(connection: Connection, private: sqlite3.Connection, differing: list[tuple[str, int]]) -> None:
    """Index the words of all events in the table `again`, and list those of which the index has other facets."""
    private.execute(WORDS_TABLE.replace("event_words", "again"))

    def words() -> Iterator[tuple[int, str]]:
        for event in indexed_events(connection):
            if not event.agrees:
                differing.append((event.run_id, event.seq))
            yield event.position, words_of(event.actor, event.payload)

    private.executemany("INSERT INTO again (rowid, words) VALUES (?, ?)", words())


def _compared(connection: Connection, private: sqlite3.Connection) -> tuple[list[int], str]:
    """Return positions of events whose words differ, and what is wrong with the index itself ("" if nothing)."""
    private.execute(WORDS_TABLE.replace("event_words", "present"))
    for part, columns in _PARTS.items():
        private.execute(f"DELETE FROM present_{part}")
        rows = connection.execute(text(f"SELECT {columns} FROM event_words_{part}"))
        marks = ", ".join("?" for _ in columns.split(","))
        private.executemany(f"INSERT INTO present_{part} ({columns}) VALUES ({marks})", (tuple(row) for row in rows))
    private.commit()
    versions = [private.execute(f"SELECT k, v FROM {name}_config ORDER BY k").fetchall() for name in _BOTH]
    if versions[0] != versions[1]:
        return [], f"{_DAMAGED}: it is of format {versions[0]}, not {versions[1]}"
    for name in _BOTH:
        private.execute(f"CREATE VIRTUAL TABLE {name}_places USING fts5vocab({name}, 'instance')")
    private.execute("CREATE VIRTUAL TABLE words USING fts5vocab(again, 'row')")
    if not _same(*(private.execute(f"SELECT term, doc, col, offset FROM {name}_places") for name in _BOTH)):
        wrong = [int(row[0]) for row in private.execute(_OTHER.format(*_BOTH))]
        return wrong, f"{_DAMAGED}: it does not hold the words of the events"
    # A correct list of words does not prove that searching works: a search descends by the first words of the index's
    # pages, which may be damaged. So search for every word.
    for (term,) in private.execute("SELECT term FROM words"):
        asked = (f"SELECT count(*) FROM {name} WHERE {name} MATCH ?" for name in _BOTH)
        found, awaited = (private.execute(ask, (f'"{term}"',)).fetchone()[0] for ask in asked)
        if found != awaited:
            return [], f"{_DAMAGED}: a search for {term!r} finds {found} events, {awaited} have the word"
    private.execute("INSERT INTO present (present) VALUES ('integrity-check')")
    return [], ""


def _same(one: sqlite3.Cursor, other: sqlite3.Cursor) -> bool:
    while True:
        here, there = one.fetchmany(1000), other.fetchmany(1000)
        if here != there:
            return False
        if not here:
            return True


# Index rows that differ from their events, and events that are missing from the index. What is read out of payloads
# is compared by `content_faults`, which reads them all.
# All columns are named explicitly: a flipped bit in the stored schema may turn a lower-case letter into a capital.
_INDEX = """
SELECT coalesce(e.run_id, i.run_id) AS run_id, coalesce(e.seq, i.seq) AS seq,
       e.seq IS NULL AS foreign_row, i.seq IS NULL AS missing_row
FROM {left} LEFT JOIN {right} ON e.run_id = i.run_id AND e.seq = i.seq
WHERE e.seq IS NULL OR i.seq IS NULL OR i.kind <> e.kind OR i.actor <> e.actor
"""


_FOREIGN_FACETS = """
SELECT DISTINCT f.run_id AS run_id, f.seq AS seq
FROM event_facets AS f LEFT JOIN events AS e ON e.run_id = f.run_id AND e.seq = f.seq WHERE e.seq IS NULL
"""
# Positions count up in the order of writing over all runs.
_PLACES = """
SELECT run_id AS run_id, seq AS seq, place AS place, before AS before,
       position - row_number() OVER (ORDER BY position) AS gap
FROM (SELECT run_id, seq, position, position AS place,
             lag(seq) OVER (PARTITION BY run_id ORDER BY position) AS before FROM event_index) AS placed
ORDER BY position
"""
# CROSS JOIN makes SQLite look up the event of each job; otherwise it may scan all jobs for each event.
_QUEUE = """
SELECT j.run_id AS run_id, j.enqueued_seq AS enqueued_seq, j.job_id AS job_id, j.position AS position,
       row_number() OVER (ORDER BY i.position) AS place
FROM jobs AS j CROSS JOIN event_index AS i WHERE i.run_id = j.run_id AND i.seq = j.enqueued_seq ORDER BY i.position
"""
_STATISTICS = {("table", "sqlite_stat1"), ("table", "sqlite_stat4")}  # made by ANALYZE, which is harmless
_NUMBERS = ("application_id",)  # in the database's header, which this software leaves 0


def schema_faults(connection: Connection) -> Iterator[Fault]:
    """Yield a fault for each table, index and trigger that differs from that of this software.

    A changed trigger may protect nothing.
    """
    for name in _NUMBERS:
        number = connection.execute(text(f"PRAGMA {name}")).scalar_one()
        if number != 0:
            yield Fault(None, None, DATABASE_NAME, f"its {name} is {number}: this software leaves it 0")
    present = {key: made for key, made in read_schema(connection).items() if key not in _STATISTICS}
    expected = fresh_schema()
    for (kind, name), made in expected.items():
        if (kind, name) not in present:
            consequence = ": the evidence could be changed" if kind == "trigger" else ""
            yield Fault(None, None, DATABASE_NAME, f"the {kind} {name} is missing{consequence}")
        elif present[kind, name] != made:
            yield Fault(None, None, DATABASE_NAME, f"the {kind} {name} is not the one that this software makes")
    for kind, name in present.keys() - expected.keys():
        yield Fault(None, None, DATABASE_NAME, f"the {kind} {name} is not of this software")


def reference_faults(connection: Connection) -> Iterator[Fault]:
    """Yield a fault for each row that refers to a missing row, such as a lease on a run that does not exist."""
    for row in connection.execute(text("PRAGMA foreign_key_check")):
        what = f"row {row.rowid} of the table {row.table} belongs to a row of {row.parent} that is not there"
        yield Fault(None, None, DATABASE_NAME, what)


def index_faults(connection: Connection, run_ids: Sequence[str], *, every_run: bool) -> Iterator[Fault]:
    """Yield a fault for each row of the event index that is missing, foreign, out of order or unlike its event.

    With `every_run`, rows of runs that do not exist are reported too.
    """
    wanted = frozenset(run_ids)
    for left, right in (("events AS e", "event_index AS i"), ("event_index AS i", "events AS e")):
        seen_before = left.startswith("event_index")
        for row in connection.execute(text(_INDEX.format(left=left, right=right))):
            here = row.run_id in wanted or every_run
            if not here or (seen_before and not row.foreign_row):
                continue
            what = INDEX_DIFFERS
            if row.missing_row:
                what = "the event is missing from the index by which auditors filter"
            elif row.foreign_row:
                what = "the index of events has a row of an event that is not there"
            yield Fault(str(row.run_id), int(row.seq), "", what)
    for row in connection.execute(text(_FOREIGN_FACETS)):
        if row.run_id in wanted or every_run:
            what = "the index of events has facets of an event that is not there"
            yield Fault(str(row.run_id), int(row.seq), "", what)
    gap = 0
    for row in connection.execute(text(_PLACES)):
        moved, gap = row.gap != gap or row.seq != (row.before or 0) + 1, row.gap
        if moved and (row.run_id in wanted or every_run):
            what = f"its place in the index of events ({row.place}) is not that in which it was written"
            yield Fault(str(row.run_id), int(row.seq), "", what)


def queue_faults(connection: Connection, run_ids: Sequence[str]) -> Iterator[Fault]:
    """Yield a fault for each job whose position in the queue is not that in which it was enqueued, over all runs."""
    wanted = frozenset(run_ids)
    for row in connection.execute(text(_QUEUE)):
        if row.position != row.place and row.run_id in wanted:
            what = f"job {row.job_id} has another place in the queue ({row.position}) than it got ({row.place})"
            yield Fault(str(row.run_id), int(row.enqueued_seq), "", what)
