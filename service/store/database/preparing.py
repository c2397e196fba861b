"""Make the tables of a site in PostgreSQL, or upgrade those of an earlier version, as their owner."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.core.errors import StoreError
from service.store.database import postgres_schema
from service.store.database.postgres import PostgresDatabase, engine_for
from service.store.database.revisions import REVISIONS, migrate, refuse_foreign, refuse_newer, revision_of
from service.store.durable_effects import DurableFiles

_AS_OWNER = "Name the owner in the address, postgresql://OWNER@HOST/DATABASE; nothing was changed"


@dataclass(frozen=True, slots=True)
class Prepared:
    """The result of preparing a database."""

    before: str | None  # the revision before; None: it was empty
    revision: str
    granted: tuple[str, ...]  # the missing privileges, such as "SELECT, INSERT on events"


def prepare(owner_url: str, role: str) -> Prepared:
    """Make or upgrade the tables of a site as their owner, and grant the program's role its missing privileges.

    All of it is one transaction, during which no program writes. An interruption leaves the database as it was.

    Raises:
        StoreVersionError: a newer version prepared the database, or it has tables that are not orthocapture's.
        StoreError: it cannot be reached, or its tables belong to another role.
    """
    database = PostgresDatabase(engine_for(owner_url), DurableFiles())
    try:
        with database.preparing() as connection:
            present = revision_of(connection)
            refuse_newer(present, database.where)
            if present is None:
                refuse_foreign(connection, database.where, "Name an empty database; nothing was changed")
                postgres_schema.make(connection)
            else:
                _require_owner(connection, database.where)
                if present != REVISIONS[-1]:
                    migrate(connection)
            return Prepared(present, REVISIONS[-1], postgres_schema.grant(connection, role))
    finally:
        database.close()


def _require_owner(connection: Connection, where: str) -> None:
    asked = "SELECT pg_get_userbyid(relowner), current_user FROM pg_class WHERE oid = to_regclass('alembic_version')"
    owner, user = connection.execute(text(asked)).one()
    if owner != user:
        what = f"the tables belong to the role {owner}, and this address names {user}"
        raise StoreError(what, where=where, remedy=_AS_OWNER)
