"""The database of a data folder as an outsider reaches it, past the program: SQLite's file, or a superuser's session.

Whatever tests do to a record from outside goes through here, so that they are the same for both databases; what is
about SQLite's file alone carries the mark `sqlite`.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Protocol, cast

import yaml

from service.store.data_folder import SITE_FILE
from service.store.database.engine import database_path
from service.store.database.opening import named_database
from service.store.event_index import facets_of, vector, words_of
from service.store.store import Store
from tests.support.record.stepped_clock import SteppedClock

# Writes facets and words of the present events again, with the functions of `know_index`; tamper() has dropped the
# triggers before this runs.
INDEX_AGAIN = (
    "DELETE FROM event_facets",
    "INSERT INTO event_facets SELECT e.run_id, e.seq, f.key, f.value "
    "FROM events AS e JOIN json_each(facets_of(e.payload)) AS f",
    "INSERT INTO event_words (event_words) VALUES ('delete-all')",
    "INSERT INTO event_words (rowid, words) SELECT i.position, words_of(e.actor, e.payload) "
    "FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq ORDER BY i.position",
)
_PRESENT = (
    "SELECT i.position, e.run_id, e.seq, e.actor, e.payload FROM event_index AS i "
    "JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq"
)
_DISCONNECT = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() AND pid <> "


class Outsider(Protocol):
    """A connection of an outsider: each statement is committed when the block ends."""

    def execute(self, statement: str, parameters: Sequence[Any] = ()) -> Any:
        """Execute SQL with `?` for parameters; returns a cursor."""
        ...


class _Superuser:
    """The superuser's connection to a database of the tests' cluster, with the parameters of SQLite's driver."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection

    def execute(self, statement: str, parameters: Sequence[Any] = ()) -> Any:
        if not parameters:
            return self.connection.execute(statement.encode())
        return self.connection.execute(statement.replace("%", "%%").replace("?", "%s").encode(), parameters)


def is_postgres(data_dir: Path) -> bool:
    """Return whether the record of a data folder is in PostgreSQL."""
    return named_database(data_dir) is not None


def signer_events(data_dir: Path) -> int:
    """Return how many events name who signs, in the site's chain before its first signature: one in PostgreSQL."""
    return int(is_postgres(data_dir))


@contextmanager
def outsider(data_dir: Path) -> Generator[Outsider]:
    """Connect to the database of a data folder past the program; commits at the end of the block."""
    if not is_postgres(data_dir):
        with closing(sqlite3.connect(database_path(data_dir))) as connection:
            know_index(connection)
            yield cast("Outsider", connection)
            connection.commit()
        return
    import psycopg  # noqa: PLC0415 - for sites only

    with closing(psycopg.connect(_superusers_address(data_dir))) as session:
        yield _Superuser(session)
        session.commit()


def rows(data_dir: Path, sql: str) -> list[tuple[object, ...]]:
    """Query as an outsider would."""
    with outsider(data_dir) as connection:
        return [tuple(row) for row in connection.execute(sql)]


def know_index(connection: sqlite3.Connection) -> None:
    """Give SQL the functions by which the index of events is made: words_of(actor, payload), facets_of(payload)."""
    connection.create_function("words_of", 2, lambda actor, payload: words_of(actor, json.loads(payload)))
    connection.create_function("facets_of", 1, lambda payload: json.dumps(dict(facets_of(json.loads(payload)))))


def tamper(data_dir: Path, *statements: str) -> None:
    """Change evidence as somebody with full access would: without the triggers, which are there again afterwards."""
    with outsider(data_dir) as connection:
        if isinstance(connection, _Superuser):
            connection.execute("SET session_replication_role = replica")
            for statement in statements:
                if statement not in INDEX_AGAIN:
                    if not statement.startswith("PRAGMA foreign_keys"):  # the session asks for none of them
                        connection.execute(statement)
                elif statement == INDEX_AGAIN[-1]:
                    _index_again(connection)
            return
        triggers: list[tuple[str, str]] = list(
            connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")
        )
        for name, _sql in triggers:
            connection.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            connection.execute(statement)
        for _name, sql in triggers:
            connection.execute(sql)


def pass_time(store: Store, clock: SteppedClock, seconds: float) -> None:
    """Let time pass: the test's clock goes on, and the leases that the server's clock judges are older by as much."""
    clock.passed_s += seconds
    data = store.database_path.parent
    if is_postgres(data):
        with outsider(data) as connection:
            for table in ("leases", "jobs"):
                connection.execute(f"UPDATE {table} SET until_utc_s = until_utc_s - {seconds}")


def write_site_file(data_dir: Path, said: Mapping[str, object]) -> None:
    """Write what a site.yaml says besides the database that it may name already."""
    path = data_dir / SITE_FILE
    before: dict[str, object] = yaml.safe_load(path.read_text()) if path.exists() else {}
    database = {name: value for name, value in before.items() if name == "database"}
    path.write_text(yaml.safe_dump(database | dict(said)))


def copy_data(source: Path, target: Path) -> Path:
    """Copy a folder, with the databases of the data folders in it, as a backup of a whole machine would."""
    shutil.copytree(source, target, dirs_exist_ok=True)
    for named in sorted(target.rglob(SITE_FILE)):
        if is_postgres(named.parent):
            _give_own_database(source / named.relative_to(target), named)
    return target


def _give_own_database(of_source: Path, of_target: Path) -> None:
    from tests.support.processes.postgres import cluster_of  # noqa: PLC0415 - for sites only

    address = named_database(of_source.parent)
    assert address is not None
    cluster, database = cluster_of(address)
    cluster.run(database, f"{_DISCONNECT} pg_backend_pid()")
    copy = cluster.copy_of(database)
    of_target.write_text(of_source.read_text().replace(f"/{database}?", f"/{copy}?"))


def _superusers_address(data_dir: Path) -> str:
    from tests.support.processes.postgres import OTHER, cluster_of  # noqa: PLC0415 - for sites only

    address = named_database(data_dir)
    assert address is not None
    cluster, database = cluster_of(address)
    return cluster.url(database, OTHER)


def _index_again(connection: Outsider) -> None:
    """Do what INDEX_AGAIN says, for PostgreSQL, which has none of its functions."""
    present = list(connection.execute(_PRESENT))
    for table in ("event_facets", "event_words"):
        connection.execute(f"DELETE FROM {table}")
    for position, run_id, seq, actor, text in present:
        payload = json.loads(text)
        for name, value in facets_of(payload):
            connection.execute("INSERT INTO event_facets VALUES (?, ?, ?, ?)", (run_id, seq, name, value))
        vectors = vector(words_of(actor, payload))
        connection.execute("INSERT INTO event_words VALUES (?, CAST(? AS tsvector))", (position, vectors))
