"""The log of starts of the service: what runs here, what changed since the last start, and which runs are open."""

from __future__ import annotations

import hashlib
import os
import socket
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from sqlalchemy import Connection, func, select

from service.core.errors import ConfigurationError
from service.core.records.events import Event, ServiceStarted
from service.rig import Rig
from service.runner.held_run import software_versions
from service.store.database.tables import checkpoints, event_index, events, heads
from service.store.durable_effects import Clock
from service.store.events import to_event
from service.store.records import SITE
from service.store.runs import ProcessIdentity, read_open_runs
from service.store.store import Store


def record_start(store: Store, rig: Rig, protocols: Sequence[Path], address: str) -> ServiceStarted:
    """Record in the site's chain that the service started, with its files, its software and the open runs.

    The record holds the ends of all chains that grew since the last start, which reveal a run that is cut later.
    Raises ConfigurationError for a protocol file that cannot be read.
    """
    software = software_versions()
    configuration = {str(rig.path): hashlib.sha256(rig.source).hexdigest()} | _hashes(protocols)
    boot = ProcessIdentity.of_this_process().boot
    with store.database.writing() as connection:
        last, position = _last_start(connection)
        before = last.payload if last is not None and isinstance(last.payload, ServiceStarted) else None
        started = ServiceStarted(
            host=socket.gethostname(),
            pid=os.getpid(),
            address=address,
            software=software,
            changed={
                **_changes(before.software if before else {}, software),
                **_changes(before.configuration if before else {}, configuration),
            }
            if before
            else {},
            configuration=configuration,
            boot=boot,
            clock_jump_s=_clock_jump_s(store.clock, last) if last is not None and _same_boot(before, boot) else None,
            heads=_heads_since(connection, position),
            unsigned_runs=_unsigned_runs(connection),
            open_runs=tuple(sorted(read_open_runs(connection))),
        )
        store.append_site(connection, [started], actor="service", software=software)
    return started


def _hashes(files: Sequence[Path]) -> dict[str, str]:
    try:
        return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    except OSError as error:
        raise ConfigurationError(
            f"a protocol file cannot be read: {error.strerror}", where=str(error.filename)
        ) from error


def _changes(before: Mapping[str, str], now: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Name → before, now; "" for what did not exist."""
    names = sorted({*before, *now})
    return {n: (before.get(n, ""), now.get(n, "")) for n in names if before.get(n) != now.get(n)}


def _last_start(connection: Connection) -> tuple[Event | None, int]:
    """Return the last ServiceStarted and its position among all events; (None, 0) if there is none."""
    found = (
        select(event_index.c.seq, event_index.c.position)
        .where(event_index.c.run_id == SITE, event_index.c.kind == "service_started")
        .order_by(event_index.c.seq.desc())
        .limit(1)
    )
    place = connection.execute(found).one_or_none()
    if place is None:
        return None, 0
    row = connection.execute(select(events).where(events.c.run_id == SITE, events.c.seq == place.seq)).one()
    return to_event(row), place.position


def _same_boot(before: ServiceStarted | None, boot: str) -> bool:
    return before is not None and boot != "" and (before.boot, before.host) == (boot, socket.gethostname())


def _clock_jump_s(clock: Clock, last: Event) -> float:
    """Return seconds by which UTC advanced more than the monotonic clock since the last start: how far it was set."""
    utc_s = clock.utc_s() - datetime.fromisoformat(last.at_utc).timestamp()
    return round(utc_s - (clock.monotonic_s() - last.monotonic_s), 6)


def _heads_since(connection: Connection, position: int) -> dict[str, tuple[int, str]]:
    grown = select(event_index.c.run_id).where(event_index.c.position > position).distinct()
    found = select(heads).where(heads.c.run_id.in_(grown), heads.c.run_id != SITE).order_by(heads.c.run_id)
    return {row.run_id: (row.seq, row.sha256) for row in connection.execute(found)}


def _unsigned_runs(connection: Connection) -> tuple[str, ...]:
    signed = (
        select(checkpoints.c.run_id, func.max(checkpoints.c.seq).label("seq"))
        .group_by(checkpoints.c.run_id)
        .subquery()
    )
    found = (
        select(heads.c.run_id)
        .outerjoin(signed, signed.c.run_id == heads.c.run_id)
        .where(heads.c.run_id != SITE, func.coalesce(signed.c.seq, 0) < heads.c.seq)
        .order_by(heads.c.run_id)
    )
    return tuple(connection.execute(found).scalars())
