"""The rows of the database that verification checks, read in one transaction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Table, select, text

from service.store.database.database import is_postgres
from service.store.database.tables import (
    accounts,
    artefacts,
    checkpoints,
    events,
    heads,
    invitations,
    jobs,
    runs,
    sessions,
)
from service.store.records import SITE, Checkpoint, Timestamp, UnknownRunError
from service.store.signatures.checkpoints import read_checkpoints, read_timestamps

_Rows = dict[str, list[dict[str, Any]]]  # by run


@dataclass(frozen=True, slots=True)
class EvidenceRows:
    """All rows other than the events, which may be many and are streamed instead."""

    run_ids: tuple[str, ...]
    has_site: bool
    runs: _Rows
    heads: _Rows
    artefacts: _Rows
    jobs: _Rows
    checkpoints: Mapping[str, list[Checkpoint]]
    timestamps: Mapping[str, list[Timestamp]]
    every_sha256: frozenset[str]
    accounts: Sequence[Mapping[str, Any]]
    links: Sequence[Mapping[str, Any]]
    sessions: Sequence[Mapping[str, Any]]
    damage: tuple[str, ...]


def read_evidence(connection: Connection, run_id: str | None) -> EvidenceRows:
    """Return the rows of a run and of the site, or with None those of every run. Raises UnknownRunError."""
    damage = database_damage(connection)
    known = set(connection.execute(select(runs.c.run_id)).scalars())
    # A run whose row was deleted may still have events or checkpoints.
    known |= set(connection.execute(select(events.c.run_id).distinct()).scalars())
    known |= set(connection.execute(select(checkpoints.c.run_id).distinct()).scalars())
    if run_id is not None and run_id not in known:
        raise UnknownRunError(
            f"there is no run {run_id!r}",
            where=str(connection.engine.url.database),
            remedy="List the runs with `orthocapture status`",
        )
    chosen = tuple(sorted(known)) if run_id is None else (run_id,)
    read = tuple({*chosen, SITE})

    def rows(table: Table, *order: Any) -> _Rows:
        grouped: _Rows = {}
        statement = select(table).where(table.c.run_id.in_(read)) if run_id is not None else select(table)
        for row in connection.execute(statement.order_by(*order)).mappings():
            grouped.setdefault(str(row["run_id"]), []).append(dict(row))
        return grouped

    def all_of(table: Table) -> list[dict[str, Any]]:
        return [dict(row) for row in connection.execute(select(table)).mappings()]

    return EvidenceRows(
        run_ids=chosen,
        has_site=SITE in known,
        runs=rows(runs),
        heads=rows(heads),
        artefacts=rows(artefacts, artefacts.c.run_id, artefacts.c.seq, artefacts.c.position),
        jobs=rows(jobs, jobs.c.position),
        checkpoints={run: read_checkpoints(connection, run) for run in read},
        timestamps={run: read_timestamps(connection, run) for run in read},
        every_sha256=frozenset(connection.execute(select(artefacts.c.sha256)).scalars()),
        accounts=all_of(accounts),
        links=all_of(invitations),
        sessions=all_of(sessions),
        damage=damage,
    )


def database_damage(connection: Connection) -> tuple[str, ...]:
    """Return the messages of SQLite's own check of the database; empty if it is sound, or of a server."""
    if is_postgres(connection):
        return ()
    found = connection.execute(text("PRAGMA integrity_check(5)")).scalars()
    return tuple(f"SQLite finds the database damaged: {line}" for line in found if line != "ok")


def event_rows(connection: Connection, run_id: str) -> Iterator[Mapping[Any, Any]]:
    """Yield the events of a run in order, read a part at a time."""
    statement = select(events).where(events.c.run_id == run_id).order_by(events.c.seq)
    with connection.execution_options(yield_per=500).execute(statement) as rows:
        yield from rows.mappings()
