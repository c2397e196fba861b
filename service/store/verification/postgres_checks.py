"""Check a PostgreSQL database: its tables, triggers and grants are this software's, its words those of the events.

Who owns the tables or is a superuser can switch triggers off, or grant itself more. What is changed then is found by
hashes and signatures; what made the change possible is found here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sqlalchemy import (
    Connection,
    ForeignKeyConstraint,
    PrimaryKeyConstraint,
    UniqueConstraint,
    text,
)
from sqlalchemy.sql.schema import ColumnCollectionConstraint

from service.store.database import postgres
from service.store.database.tables import metadata
from service.store.event_index import indexed_events, vector, words_of
from service.store.verification.chain_checks import Fault
from service.store.verification.derived_checks import INDEX_DIFFERS

_WHERE = "the database"
_AT_ONCE = 500  # events
_COLUMNS = text(
    "SELECT c.relname, a.attname, format_type(a.atttypid, a.atttypmod), a.attnotnull FROM pg_attribute AS a "
    "JOIN pg_class AS c ON c.oid = a.attrelid WHERE c.relnamespace = 'public'::regnamespace AND c.relkind = 'r' "
    "AND a.attnum > 0 AND NOT a.attisdropped"
)
_CONSTRAINTS = text(
    "SELECT c.relname, k.conname FROM pg_constraint AS k JOIN pg_class AS c ON c.oid = k.conrelid "
    "WHERE c.relnamespace = 'public'::regnamespace AND k.convalidated AND k.contype IN ('p', 'u', 'f', 'c')"
)
_TRIGGERS = text(
    "SELECT c.relname, t.tgname, t.tgenabled, t.tgtype, p.prosrc FROM pg_trigger AS t "
    "JOIN pg_class AS c ON c.oid = t.tgrelid JOIN pg_proc AS p ON p.oid = t.tgfoid "
    "WHERE c.relnamespace = 'public'::regnamespace AND NOT t.tgisinternal"
)
_GRANTS = text(
    "SELECT c.relname, pg_get_userbyid(g.grantee) AS grantee, g.privilege_type FROM pg_class AS c "
    "CROSS JOIN LATERAL aclexplode(c.relacl) AS g "
    "WHERE c.relnamespace = 'public'::regnamespace AND c.relkind = 'r' AND g.grantee <> c.relowner"
)
_DIFFERENT_WORDS = text(
    "SELECT e.position FROM unnest(CAST(:positions AS bigint[]), CAST(:vectors AS text[])) AS e (position, words) "
    "LEFT JOIN event_words AS w ON w.position = e.position WHERE w.words IS DISTINCT FROM CAST(e.words AS tsvector)"
)
_FOREIGN_WORDS = text(
    "SELECT w.position FROM event_words AS w LEFT JOIN event_index AS i ON i.position = w.position "
    "WHERE i.position IS NULL"
)


def schema_faults(connection: Connection) -> Iterator[Fault]:
    """Yield a fault for each column, constraint, trigger and grant that is not as this software makes it."""
    for what in (
        *_differences("column", _expected_columns(), {(t, c): (k, n) for t, c, k, n in connection.execute(_COLUMNS)}),
        *_missing("constraint", _expected_constraints(), {(t, c) for t, c in connection.execute(_CONSTRAINTS)}),
        *_differences(
            "trigger",
            postgres.triggers(),
            {(t, n): (enabled, kind, source) for t, n, enabled, kind, source in connection.execute(_TRIGGERS)},
            ": the evidence could be changed",
        ),
    ):
        yield Fault(None, None, _WHERE, what)
    for table, grantee, privilege in connection.execute(_GRANTS):
        if privilege not in postgres.granted(table):
            what = f"the role {grantee} may {privilege} on {table}: this software never grants that"
            yield Fault(None, None, _WHERE, what)


def _expected_columns() -> dict[tuple[str, str], object]:
    kinds = {"Integer": "bigint", "Text": "text", "REAL": "double precision"}
    of_metadata: dict[tuple[str, str], object] = {
        (table.name, column.name): (kinds[type(column.type).__name__], not column.nullable)
        for table in metadata.tables.values()
        for column in table.columns
    }
    return of_metadata | dict(postgres.FURTHER_COLUMNS)


def _expected_constraints() -> set[tuple[str, str]]:
    found: set[tuple[str, str]] = set(postgres.FURTHER_CONSTRAINTS)
    for table in metadata.tables.values():
        for constraint in table.constraints:
            columns = (
                "_".join(c.name for c in constraint.columns)
                if isinstance(constraint, ColumnCollectionConstraint)
                else ""
            )
            made: dict[type, str] = {
                PrimaryKeyConstraint: f"{table.name}_pkey",
                ForeignKeyConstraint: f"{table.name}_{columns}_fkey",
                UniqueConstraint: f"{table.name}_{columns}_key",
            }
            found.add((table.name, str(constraint.name) if constraint.name else made[type(constraint)]))
    return found


def _differences(
    kind: str, expected: dict[tuple[str, str], object], present: dict[tuple[str, str], object], consequence: str = ""
) -> Iterator[str]:
    yield from _missing(kind, set(expected), set(present), consequence)
    for table, name in expected.keys() & present.keys():
        if expected[table, name] != present[table, name]:
            yield f"the {kind} {name} of {table} is not the one that this software makes{consequence}"
    for table, name in present.keys() - expected.keys():
        yield f"the {kind} {name} of {table} is not of this software"


def _missing(
    kind: str, expected: set[tuple[str, str]], present: set[tuple[str, str]], consequence: str = ""
) -> Iterator[str]:
    for table, name in sorted(expected - present):
        yield f"the {kind} {name} of {table} is missing{consequence}"


def reference_faults(connection: Connection) -> Iterator[Fault]:
    """Yield a fault for rows that refer to missing rows, which only a superuser can have brought about."""
    for table in metadata.tables.values():
        for key in table.foreign_key_constraints:
            other = key.referred_table.name
            same = " AND ".join(f"b.{pair.column.name} = a.{pair.parent.name}" for pair in key.elements)
            without = f"NOT EXISTS (SELECT 1 FROM {other} AS b WHERE {same})"
            lost = connection.execute(text(f"SELECT count(*) FROM {table.name} AS a WHERE {without}")).scalar_one()
            if lost:
                what = f"{lost} rows of the table {table.name} belong to rows of {other} that are not there"
                yield Fault(None, None, _WHERE, what)


def content_faults(connection: Connection, run_ids: Sequence[str], *, every_run: bool) -> Iterator[Fault]:
    """Yield a fault for each event with other facets or words in the index than its payload has."""
    wanted = frozenset(run_ids)
    placed: dict[int, tuple[str, int]] = {}
    vectors: list[str] = []
    for event in indexed_events(connection):
        if not event.agrees and (event.run_id in wanted or every_run):
            yield Fault(event.run_id, event.seq, "", INDEX_DIFFERS)
        placed[event.position] = (event.run_id, event.seq)
        vectors.append(vector(words_of(event.actor, event.payload)))
        if len(placed) == _AT_ONCE:
            yield from _word_faults(connection, placed, vectors, wanted)
            placed, vectors = {}, []
    yield from _word_faults(connection, placed, vectors, wanted)
    for position in connection.execute(_FOREIGN_WORDS).scalars():
        what = f"the index by which auditors search has words of an event that is not there (place {position})"
        yield Fault(None, None, _WHERE, what)


def _word_faults(
    connection: Connection, placed: dict[int, tuple[str, int]], vectors: list[str], wanted: frozenset[str]
) -> Iterator[Fault]:
    found = connection.execute(_DIFFERENT_WORDS, {"positions": list(placed), "vectors": vectors}).scalars()
    for run_id, seq in (placed[position] for position in found):
        if run_id in wanted:
            yield Fault(run_id, seq, "", "the words by which auditors search are not the event's")
