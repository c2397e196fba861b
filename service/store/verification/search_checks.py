"""Check what the index says of the contents of events: derive facets and words again and compare."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing

from sqlalchemy import Connection, text

from service.store.database.engine import DATABASE_NAME
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
