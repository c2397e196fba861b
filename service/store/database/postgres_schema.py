"""The tables of a site in PostgreSQL: what they are made of, who may do what, and how a verification reads it."""

from __future__ import annotations

from collections.abc import Mapping

from sqlalchemy import Connection, text

from service.store.database.revisions import REVISIONS, postgres_triggers
from service.store.database.tables import metadata

EVIDENCE = ("runs", "events", "artefacts", "checkpoints", "timestamps", "event_index", "event_facets", "event_words")
_ENDS = ("heads",)  # inserted and moved, never removed
_OF_THE_MOMENT = ("jobs", "leases", "accounts", "invitations", "sessions", "control", "copies")
_REFUSAL = """
BEGIN
  RAISE EXCEPTION '% is append-only: % refused', TG_TABLE_NAME, lower(TG_OP);
END """
_REFUSE = f"CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS $${_REFUSAL}$$"
_FURTHER = (
    "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL PRIMARY KEY)",
    "CREATE TABLE event_words (position BIGINT NOT NULL PRIMARY KEY, words TSVECTOR NOT NULL)",
    "CREATE INDEX event_words_by_word ON event_words USING gin (words)",
    # The order of signatures; SQLite counts rows by itself, under this name.
    "ALTER TABLE checkpoints ADD COLUMN rowid BIGINT GENERATED ALWAYS AS IDENTITY",
    # The row of a run holds the hash of its first event, which refers to the row.
    "ALTER TABLE events ALTER CONSTRAINT events_run_id_fkey DEFERRABLE INITIALLY IMMEDIATE",
    "ALTER TABLE heads ALTER CONSTRAINT heads_run_id_fkey DEFERRABLE INITIALLY IMMEDIATE",
    _REFUSE.replace("%", "%%"),
)
# What these tables have beside the columns and constraints of service.store.database.tables.
FURTHER_COLUMNS: Mapping[tuple[str, str], object] = {
    ("alembic_version", "version_num"): ("character varying(32)", True),
    ("checkpoints", "rowid"): ("bigint", True),
    ("event_words", "position"): ("bigint", True),
    ("event_words", "words"): ("tsvector", True),
}
FURTHER_CONSTRAINTS = {("alembic_version", "alembic_version_pkey"), ("event_words", "event_words_pkey")}
_EVERY_ROW = 1 + 2 + 8 + 16  # of pg_trigger.tgtype: for each row, before, delete, update
_EVERY_TRUNCATE = 2 + 32  # before, truncate


def triggers() -> dict[tuple[str, str], object]:
    """Return by table and name how each trigger is enabled, its type as in pg_trigger, and what it does."""
    found: dict[tuple[str, str], object] = {}
    for table in EVIDENCE:
        found[table, f"{table}_append_only"] = ("O", _EVERY_ROW, _REFUSAL)
        found[table, f"{table}_no_truncate"] = ("O", _EVERY_TRUNCATE, _REFUSAL)
    return found


def granted(table: str) -> tuple[str, ...]:
    """Return what the program's role may do with a table."""
    if table in EVIDENCE:
        return ("SELECT", "INSERT")
    if table in _ENDS:
        return ("SELECT", "INSERT", "UPDATE")
    return ("SELECT", "INSERT", "UPDATE", "DELETE") if table in _OF_THE_MOMENT else ("SELECT",)


def make(connection: Connection) -> None:
    """Make all tables as their owner: the same that the migrations make of the tables of an earlier version."""
    metadata.create_all(connection)
    for statement in (*_FURTHER, *(made for table in EVIDENCE for made in postgres_triggers(table))):
        connection.exec_driver_sql(statement)
    connection.execute(text("INSERT INTO alembic_version VALUES (:revision)"), {"revision": REVISIONS[-1]})


def grant(connection: Connection, role: str) -> tuple[str, ...]:
    """Grant a role the missing privileges, as the owner of the tables; return them, one text a table."""
    done: list[str] = []
    asked = text("SELECT has_table_privilege(:role, :table, :power)")
    for table in ("alembic_version", *EVIDENCE, *_ENDS, *_OF_THE_MOMENT):
        missing = [
            power
            for power in granted(table)
            if not connection.execute(asked, {"role": role, "table": table, "power": power}).scalar_one()
        ]
        if missing:
            connection.exec_driver_sql(f"GRANT {', '.join(missing)} ON {table} TO {_quoted(role)}")
            done.append(f"{', '.join(missing)} on {table}")
    return tuple(done)


def _quoted(role: str) -> str:
    return '"' + role.replace("%", "%%").replace('"', '""') + '"'
