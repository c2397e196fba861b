"""Copy the record of a site, or one run, from one database to another; the chains keep their hashes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Table, func, insert, select

from service.core.errors import StoreError
from service.store.database.database import Database
from service.store.database.tables import (
    accounts,
    artefacts,
    checkpoints,
    event_index,
    events,
    heads,
    invitations,
    jobs,
    runs,
    timestamps,
)
from service.store.event_index import EventToIndex, index_events, plain_payload
from service.store.runs import defer_references

_AT_ONCE = 500  # rows
_OF_RUNS = (runs, heads, artefacts, checkpoints, timestamps)
_OF_THE_SITE = (accounts, invitations)


@dataclass(frozen=True, slots=True)
class Copied:
    """What was copied: number of rows by table, and the last hash of each chain."""

    rows: dict[str, int]
    heads: dict[str, str]


def copy_record(source: Database, target: Database, run_id: str | None = None) -> Copied:
    """Copy all chains of a site into an empty database, or one run into a site, in one transaction.

    Artefacts' files are not copied. Positions follow the order in which the events were written in the source.

    Raises:
        StoreError: the target has the run already, or any run where all are copied; nothing was written.
    """
    with source.reading() as reading, target.writing() as writing:
        _require_room(writing, run_id)
        defer_references(writing)
        counted: dict[str, int] = {}
        _copy_rows(reading, writing, runs, run_id, counted)
        _copy_events(reading, writing, run_id, counted)
        for table in _OF_RUNS[1:]:
            _copy_rows(reading, writing, table, run_id, counted)
        _copy_jobs(reading, writing, run_id, counted)
        if run_id is None:
            for table in _OF_THE_SITE:
                _copy_rows(reading, writing, table, None, counted)
        ends = select(heads.c.run_id, heads.c.sha256)
        there = {row.run_id: row.sha256 for row in reading.execute(ends) if run_id in (None, row.run_id)}
        here = {row.run_id: row.sha256 for row in writing.execute(ends) if row.run_id in there}
        if there != here or not there:
            raise StoreError("the copy's chains do not end as the source's do; nothing was copied")
    return Copied(counted, here)


def _require_room(connection: Connection, run_id: str | None) -> None:
    known = set(connection.execute(select(runs.c.run_id)).scalars())
    taken = known if run_id is None else known & {run_id}
    if taken:
        raise StoreError(
            f"the target has {min(taken)} already",
            remedy="A whole site is copied into an empty database; name one run to copy it into a site with others",
        )


def _chosen(table: Table, run_id: str | None) -> Any:
    statement = select(table)
    return statement if run_id is None else statement.where(table.c.run_id == run_id)


def _chunks(connection: Connection, statement: Any) -> Iterator[Sequence[dict[str, Any]]]:
    """Yield the rows of a statement as plain values, some at a time."""
    rows = connection.execution_options(yield_per=_AT_ONCE).execute(statement)
    for chunk in rows.mappings().partitions(_AT_ONCE):
        yield [dict(row) for row in chunk]


def _copy_rows(
    reading: Connection, writing: Connection, table: Table, run_id: str | None, counted: dict[str, int]
) -> None:
    statement = _chosen(table, run_id)
    order = [table.c.at_utc] if table is checkpoints else []
    for chunk in _chunks(reading, statement.order_by(*order, *table.primary_key.columns)):
        writing.execute(insert(table), chunk)
        counted[table.name] = counted.get(table.name, 0) + len(chunk)


def _copy_events(reading: Connection, writing: Connection, run_id: str | None, counted: dict[str, int]) -> None:
    place = (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq)
    written = _chosen(events, run_id).join(event_index, place).order_by(event_index.c.position)
    for chunk in _chunks(reading, written):
        writing.execute(insert(events), chunk)
        index_events(
            writing,
            [
                EventToIndex(row["run_id"], row["seq"], row["kind"], row["actor"], plain_payload(row["payload"]))
                for row in chunk
            ],
        )
        counted["events"] = counted.get("events", 0) + len(chunk)


def _copy_jobs(reading: Connection, writing: Connection, run_id: str | None, counted: dict[str, int]) -> None:
    """Copy jobs behind those that are there, queued again where a worker has them in the source."""
    last = writing.execute(select(func.coalesce(func.max(jobs.c.position), 0))).scalar_one()
    for chunk in _chunks(reading, _chosen(jobs, run_id).order_by(jobs.c.position)):
        for row in chunk:
            last += 1
            row["position"] = last
        writing.execute(insert(jobs), chunk)
        counted["jobs"] = counted.get("jobs", 0) + len(chunk)
