"""The tables of a site in PostgreSQL: what they are made of, who may do what, and how a verification reads it."""

from __future__ import annotations

from sqlalchemy import Connection, text

from service.store.database.tables import metadata

REVISION = "0006"  # as of the migrations: a database that was prepared by an earlier one is upgraded by them
EVIDENCE = ("runs", "events", "artefacts", "checkpoints", "timestamps", "event_index", "event_facets", "event_words")
_ENDS = ("heads",)  # inserted and moved, never removed
_OF_THE_MOMENT = ("jobs", "leases", "accounts", "invitations", "sessions", "control")
_REFUSE = """
CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
  RAISE EXCEPTION '% is append-only: % refused', TG_TABLE_NAME, lower(TG_OP);
END $$
"""


def make(connection: Connection, role: str) -> None:
    """Make all tables as their owner, and grant a role what the program needs."""
    metadata.create_all(connection)
    for statement in _statements(role):
        connection.exec_driver_sql(statement.replace("%", "%%"))
    connection.execute(text("INSERT INTO alembic_version VALUES (:revision)"), {"revision": REVISION})


def _statements(role: str) -> list[str]:
    quoted = '"' + role.replace('"', '""') + '"'
    return [
        "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL PRIMARY KEY)",
        "CREATE TABLE event_words (position BIGINT NOT NULL PRIMARY KEY, words TSVECTOR NOT NULL)",
        "CREATE INDEX event_words_by_word ON event_words USING gin (words)",
        # The order of signatures; SQLite counts rows by itself, under this name.
        "ALTER TABLE checkpoints ADD COLUMN rowid BIGINT GENERATED ALWAYS AS IDENTITY",
        # The row of a run holds the hash of its first event, which refers to the row.
        "ALTER TABLE events ALTER CONSTRAINT events_run_id_fkey DEFERRABLE INITIALLY IMMEDIATE",
        "ALTER TABLE heads ALTER CONSTRAINT heads_run_id_fkey DEFERRABLE INITIALLY IMMEDIATE",
        _REFUSE,
        *(
            statement
            for table in EVIDENCE
            for statement in (
                f"CREATE TRIGGER {table}_append_only BEFORE UPDATE OR DELETE ON {table} "
                "FOR EACH ROW EXECUTE FUNCTION refuse_change()",
                f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} "
                "FOR EACH STATEMENT EXECUTE FUNCTION refuse_change()",
            )
        ),
        f"GRANT SELECT ON alembic_version TO {quoted}",
        *(f"GRANT SELECT, INSERT ON {table} TO {quoted}" for table in EVIDENCE),
        *(f"GRANT SELECT, INSERT, UPDATE ON {table} TO {quoted}" for table in _ENDS),
        *(f"GRANT SELECT, INSERT, UPDATE, DELETE ON {table} TO {quoted}" for table in _OF_THE_MOMENT),
    ]
