"""The revisions of a database, one chain for SQLite and PostgreSQL, and the upgrade from an earlier one."""

from __future__ import annotations

from sqlalchemy import Connection, inspect, text

from service.store.database.database import is_postgres
from service.store.records import StoreVersionError

REVISIONS = ("0001", "0002", "0003", "0004", "0005", "0006", "0007")  # of migrations/versions, in order
_MIGRATIONS = "service.store.database:migrations"  # package:folder, which Alembic reads with importlib.resources


def revision_of(connection: Connection) -> str | None:
    """Return the revision of a database; None if it has no tables of this software."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    revision: str | None = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()
    return revision


def refuse_newer(present: str | None, where: str) -> None:
    """Raise StoreVersionError if a newer version made or upgraded the database."""
    if present is not None and present not in REVISIONS:
        raise StoreVersionError(
            f"this database was written by a newer version of orthocapture (its revision {present} is unknown here)",
            where=where,
            remedy="Install the version that wrote it, or a newer one; nothing was changed",
        )


def refuse_foreign(connection: Connection, where: str, remedy: str) -> None:
    """Raise StoreVersionError if a database without a revision has tables."""
    if inspect(connection).get_table_names():
        raise StoreVersionError("this is not a database of orthocapture", where=where, remedy=remedy)


def migrate(connection: Connection) -> None:
    """Upgrade a database of an earlier version by the migrations; also an empty one of SQLite."""
    # The import takes half a second and is needed only where an earlier version wrote the database.
    from alembic import command  # noqa: PLC0415
    from alembic.config import Config  # noqa: PLC0415

    config = Config()
    config.set_main_option("script_location", _MIGRATIONS)
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def refuse_changes(connection: Connection, table: str, key: str) -> None:
    """Make a new table of evidence append-only by triggers, in a migration.

    Args:
        connection: a connection of the tables' owner.
        table: the name of the table.
        key: the condition on NEW, in SQL of SQLite, under which a row exists already. INSERT OR REPLACE would delete
            that row without firing the trigger on DELETE.
    """
    statements = postgres_triggers(table) if is_postgres(connection) else _sqlite_triggers(table, key)
    for statement in statements:
        connection.exec_driver_sql(statement)


def postgres_triggers(table: str) -> tuple[str, ...]:
    """Return the statements that make a table append-only in PostgreSQL."""
    return (
        f"CREATE TRIGGER {table}_append_only BEFORE UPDATE OR DELETE ON {table} "
        "FOR EACH ROW EXECUTE FUNCTION refuse_change()",
        f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} "
        "FOR EACH STATEMENT EXECUTE FUNCTION refuse_change()",
    )


def _sqlite_triggers(table: str, key: str) -> tuple[str, ...]:
    return (
        *(
            f"CREATE TRIGGER {table}_no_{verb} BEFORE {verb.upper()} ON {table} "
            f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: {verb} refused'); END"
            for verb in ("update", "delete")
        ),
        f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} "
        f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {key}) "
        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: replace refused'); END",
    )
