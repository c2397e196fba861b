"""What crashes leave in the artefact folder: found, and removed so that a run that goes on loses nothing.

A whole file without a row is either what a crash left between the file and its record, or what a living process is
about to record. So nothing is removed that is younger than the oldest process with a run or a job in hand, or than an
age that covers what has neither; storing the same bytes again makes a file young (service.store.files.artefacts).
"""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import psutil
from sqlalchemy import Connection, select

from service.core.errors import StoreError
from service.core.records.events import LeftoversRemoved
from service.store.database.tables import artefacts, jobs, leases
from service.store.durable_effects import utc_text
from service.store.files.artefacts import TEMPORARY, alone_with, hash_file, relative_path
from service.store.queue.leases import identity_of, is_live
from service.store.store import Store

USUAL_AGE_S = 3600.0  # an import or an export that has just begun holds no lease yet


@dataclass(frozen=True, slots=True)
class Leftover:
    """One file to which no record refers.

    Attributes:
        path: within the data folder.
        size_bytes: of the file.
        written_utc: when it was last written, or stored again.
        kind: `part` is a write that was cut off, `unrecorded` a whole file whose record never came.
        stays: why it is not removed now; "" where it may be.
    """

    path: str
    size_bytes: int
    written_utc: str
    kind: Literal["part", "unrecorded"]
    stays: str = ""


def leftovers(store: Store, *, min_age_s: float = USUAL_AGE_S) -> list[Leftover]:
    """Every leftover, by its path; nothing is changed.

    What is neither named by its content nor a part of a write is no leftover: `audit verify` calls it a fault.

    Raises:
        StoreError: the folder or the database cannot be read.
    """
    try:
        found = list(_candidates(store.artefact_folder))
        with store.database.reading() as connection:
            return _judged(connection, found, min_age_s)
    except OSError as error:
        raise _refused(error) from error


def remove_leftovers(store: Store, *, actor: str, min_age_s: float = USUAL_AGE_S) -> list[Leftover]:
    """Remove every leftover that may be, and write down which in the site's chain; those that were removed.

    Nobody stores a file meanwhile. A crash in the middle leaves some that are said to be removed; the next call
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
        f"what crashes have left cannot be looked through or removed: {error.strerror or error}",
        where=str(error.filename or ""),
        remedy="Check the permissions of the data folder; nothing that is recorded was touched",
    )


def _candidates(folder: Path) -> list[tuple[Path, float, int]]:
    """Files that look like leftovers, with the time of their last change (s, UTC) and their size, by path."""
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


def _judged(connection: Connection, found: Collection[tuple[Path, float, int]], min_age_s: float) -> list[Leftover]:
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
            one = replace(one, stays=f"{writer} works here since before it was written, and may still record it")
        elif time.time() - changed_s < min_age_s:
            one = replace(one, stays=f"it is younger than {min_age_s / 60:g} minutes")
        judged.append(one)
    return judged


def _oldest_writer(connection: Connection) -> tuple[float, str]:
    """Since when (s, UTC) the oldest process works that has a run or a job here, and its name; infinity: none."""
    now_s, oldest = time.time(), (float("inf"), "")
    held = [(row, row.holder) for row in connection.execute(select(leases))]
    held += [(row, row.worker) for row in connection.execute(select(jobs).where(jobs.c.state == "running"))]
    for row, name in held:
        if is_live(row, now_s):
            there = identity_of(row).life() == "lives"
            # Of a process on another host it is not known since when it works: nothing is removed beside it.
            begun_s = psutil.boot_time() + row.process_started_s if there else 0.0
            oldest = min(oldest, (begun_s, str(name)))
    return oldest
