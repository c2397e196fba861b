"""Find and remove what crashes left in the artefact folder, without harming a run in progress.

A complete file without a row was either left by a crash before its record, or is about to be recorded by a living
process. So a file stays if it is newer than the start of the oldest process that holds a run or a job, or younger
than a minimum age, for processes that hold neither. Storing the same bytes again makes a file new (files.artefacts).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import psutil
from sqlalchemy import Connection, select

from service.core.errors import StoreError
from service.core.records.events import LeftoversRemoved
from service.store.database.tables import artefacts, event_index, events, jobs, leases
from service.store.durable_effects import Clock, utc_text
from service.store.files.artefacts import TEMPORARY, alone_with, hash_file, relative_path
from service.store.queue.leases import identity_of
from service.store.store import Store

USUAL_AGE_S = 3600.0  # an import or export that has just begun holds no lease yet


@dataclass(frozen=True, slots=True)
class Leftover:
    """One file to which no record refers.

    Attributes:
        path: relative to the data folder.
        size_bytes: its size.
        written_utc: when it was last written or stored again.
        kind: `part` is an interrupted write, `unrecorded` a complete file that was never recorded.
        stays: why it must not be removed now; "" if it may be.
    """

    path: str
    size_bytes: int
    written_utc: str
    kind: Literal["part", "unrecorded"]
    stays: str = ""


def leftovers(store: Store, *, min_age_s: float = USUAL_AGE_S) -> list[Leftover]:
    """Every leftover, sorted by path; nothing is changed.

    Other foreign files, neither named by their hash nor an interrupted write, are faults for `audit verify`.

    Raises:
        StoreError: the folder or the database cannot be read.
    """
    try:
        found = list(_candidates(store.artefact_folder))
        with store.database.reading() as connection:
            set_forward_s = _set_forward_s(connection, store.clock)
            return _judged(connection, found, min_age_s, store.clock.utc_s() - set_forward_s)
    except OSError as error:
        raise _refused(error) from error


def remove_leftovers(store: Store, *, actor: str, min_age_s: float = USUAL_AGE_S) -> list[Leftover]:
    """Remove every leftover that may be removed, record it in the site's chain, and return what was removed.

    The folder is locked meanwhile. After a crash in between, files recorded as removed may still exist; the next call
    removes them.

    Raises:
        StoreError: a file cannot be removed, or the record cannot be written.
    """
    folder = store.artefact_folder
    try:
        with alone_with(folder):
            gone = [one for one in leftovers(store, min_age_s=min_age_s) if not one.stays]
            if gone:
                removed = {one.path: one.size_bytes for one in gone}
                store.record_site([LeftoversRemoved(files=removed)], actor=actor)
            for one in gone:
                store.files.remove(folder.parent / one.path)
            for directory in sorted({(folder.parent / one.path).parent for one in gone}):
                store.files.sync_directory(directory)
    except OSError as error:
        raise _refused(error) from error
    return gone


def _refused(error: OSError) -> StoreError:
    return StoreError(
        f"files left by crashes cannot be listed or removed: {error.strerror or error}",
        where=str(error.filename or ""),
        remedy="Check the permissions of the data folder; nothing that is recorded was touched",
    )


def _candidates(folder: Path) -> list[tuple[Path, float, int]]:
    """(path, time of last change in s UTC, size in bytes) of files that look like leftovers, sorted by path."""
    found: list[tuple[Path, float, int]] = []
    for path in sorted(folder.glob("*/*")):
        if path.is_symlink() or not path.is_file():
            continue
        inside = path.relative_to(folder)
        part = inside.parts[0] == TEMPORARY and path.suffix == ".part"
        try:
            named = inside == relative_path(path.name)
        except StoreError:
            named = False
        if part or named:
            status = path.stat()
            found.append((path, max(status.st_ctime, status.st_mtime), status.st_size))
    return found


def _judged(
    connection: Connection, found: Collection[tuple[Path, float, int]], min_age_s: float, earliest_now_utc_s: float
) -> list[Leftover]:
    recorded = set(connection.execute(select(artefacts.c.sha256)).scalars())
    begun_s, writer = _oldest_writer(connection)
    judged: list[Leftover] = []
    for path, changed_s, size in found:
        part = path.suffix == ".part"
        if path.name in recorded or not (part or hash_file(path)[0] == path.name):
            continue
        one = Leftover(
            path=str(path.relative_to(path.parents[2])),
            size_bytes=size,
            written_utc=utc_text(datetime.fromtimestamp(changed_s, UTC)),
            kind="part" if part else "unrecorded",
        )
        if changed_s >= begun_s:
            one = replace(one, stays=f"{writer} was already running when it was written and may still record it")
        elif min_age_s > 0 and earliest_now_utc_s - changed_s < min_age_s:
            one = replace(one, stays=f"it is, or may be, younger than {min_age_s / 60:g} minutes")
        judged.append(one)
    return judged


def _set_forward_s(connection: Connection, clock: Clock) -> float:
    """By how much UTC has gone on farther than the monotonic clock since the newest event; 0 if it has not.

    So much younger a file may be than it seems. Where the host was restarted since, this is 0 or makes files stay.
    """
    newest = select(events.c.at_utc, events.c.monotonic_s).join(
        event_index, (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq)
    )
    last = connection.execute(newest.order_by(event_index.c.position.desc()).limit(1)).first()
    passed_s = 0.0 if last is None else clock.monotonic_s() - last.monotonic_s
    if last is None or passed_s < 0:
        return 0.0
    return max(0.0, clock.utc_s() - datetime.fromisoformat(last.at_utc).timestamp() - passed_s)


def _oldest_writer(connection: Connection) -> tuple[float, str]:
    """Start time (s, UTC) and name of the oldest process that holds a run or a job here; infinity if none does."""
    oldest = (float("inf"), "")
    held = [
        (row, row.holder, _last_start_utc(connection, row.run_id)) for row in connection.execute(select(leases)).all()
    ]
    running = select(jobs).where(jobs.c.state == "running")
    held += [(row, row.worker, row.started_utc) for row in connection.execute(running)]
    for row, name, recorded_utc in held:
        # The end of a lease shows nothing here: this host's clock may have been set forward.
        if (life := identity_of(row).life()) != "dead":
            # The start of a process on another host is not known, so nothing is removed while it may run.
            begun_s = psutil.boot_time() + row.process_started_s if life == "lives" else 0.0
            # If the clock was set forward since, the boot seems later than the files that the process has written.
            if recorded_utc:
                begun_s = min(begun_s, datetime.fromisoformat(recorded_utc).timestamp())
            oldest = min(oldest, (begun_s, str(name)))
    return oldest


def _last_start_utc(connection: Connection, run_id: str) -> str:
    """When a runner last began to work on the run, as it was recorded then; "" if none has."""
    started = (
        select(events.c.at_utc)
        .join(event_index, (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq))
        .where(event_index.c.run_id == run_id, event_index.c.kind == "session_started")
        .order_by(events.c.seq.desc())
        .limit(1)
    )
    return str(connection.execute(started).scalar() or "")
