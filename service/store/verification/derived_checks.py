"""Check what can be derived again: the database's schema, references between rows, the event index, the queue."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sqlalchemy import Connection, text

from service.store.database.engine import DATABASE_NAME, fresh_schema, read_schema
from service.store.verification.chain_checks import Fault
from service.store.verification.search_checks import INDEX_DIFFERS

# Index rows that differ from their events, and events that are missing from the index. What is read out of payloads
# is compared in search_checks, which reads them all.
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
