"""Measures the used and free disk space, lists what could be deleted, and removes the files that crashes left."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import psutil
from sqlalchemy import Connection, func, select, text

from service.core.disk_space import LEAST_FREE_BYTES, Forecast, Usage, forecast, size_words
from service.core.errors import SpaceShortError, StoreError
from service.core.protocol import Protocol
from service.core.records.events import LeftoversRemoved
from service.core.run.state import RunState
from service.store.artefacts import TEMPORARY, alone_with, hash_file, relative_path
from service.store.database.tables import artefacts, event_index, events, jobs, leases
from service.store.durable_effects import Clock, utc_text
from service.store.event_index import facet_value
from service.store.runs import identity_of
from service.store.store import Store

_VIEWS = ("viewpoint_captured", "view_held", "view_imported")
_LOOKED_AT = 30  # newest runs among which one of the same protocol with photographs is looked for
# Folders below the data folder that hold no evidence.
_REMOVABLE: Mapping[str, str] = {
    "exports": "exports that were copied elsewhere",
    "logs": "logs",
    "fetched": "copies of files that the object store holds",
    "artefacts/tmp": "remains of interrupted writes",
}
_WORTH_SAYING_BYTES = 1_000_000


def forecast_of(
    store: Store, protocol: Protocol, state: RunState | None = None, *, simulated: bool = False
) -> Forecast:
    """Return the forecast for a run in progress, or for one about to begin (`state` None). Raises StoreError."""
    run_id = "" if state is None else state.run_id
    with store.database.reading() as connection:
        here = read_usage(connection, run_id) if run_id else Usage()
        before = _before(connection, run_id, protocol.id, simulated=simulated if state is None else state.simulated)
    return forecast(
        protocol,
        state,
        here,
        before,
        store.free_bytes(),
        simulated=simulated if state is None else state.simulated,
    )


def require_space(store: Store, found: Forecast) -> None:
    """Raise SpaceShortError, with a remedy, if no new work may begin."""
    if found.verdict == "stop":
        folder = store.database_path.parent
        raise SpaceShortError(found.words, where=str(folder), remedy=_helps(folder))


def require_export_space(store: Store, run_id: str, target: Path) -> None:
    """Raise SpaceShortError if a copy of a run's files would not fit or would use space reserved for the evidence."""
    with store.database.reading() as connection:
        usage = read_usage(connection, run_id)
    needed = usage.view_bytes + usage.computed_bytes + usage.other_bytes
    try:
        free, same = shutil.disk_usage(target.parent).free, _same_disk(target.parent, store.database_path.parent)
    except OSError:  # writing the export will report it
        return
    kept = LEAST_FREE_BYTES if same else 0
    if free - kept < needed:
        last = f"; the last {size_words(kept)} are kept for the evidence" if kept else ""
        raise SpaceShortError(
            f"this export needs about {size_words(needed)}, and {size_words(free)} are free{last}",
            where=str(target.parent),
            remedy="Export to another disk, or make room; nothing was written",
        )


def _same_disk(one: Path, other: Path) -> bool:
    return one.stat().st_dev == other.stat().st_dev


def read_usage(connection: Connection, run_id: str) -> Usage:
    """Return recorded sizes of a run's files so far."""
    of_event = (event_index.c.run_id == artefacts.c.run_id) & (event_index.c.seq == artefacts.c.seq)
    found = (
        select(event_index.c.kind, func.sum(artefacts.c.size_bytes), func.count(artefacts.c.seq.distinct()))
        .join(event_index, of_event)
        .where(artefacts.c.run_id == run_id)
        .group_by(event_index.c.kind)
    )
    sizes = {kind: (int(size), int(count)) for kind, size, count in connection.execute(found)}
    computed, _ = sizes.get("job_finished", (0, 0))
    views = [sizes[kind] for kind in _VIEWS if kind in sizes]
    total = sum(size for size, _ in sizes.values())
    taken = sum(size for size, _ in views)
    return Usage(sum(count for _, count in views), taken, computed, total - taken - computed)


def _before(connection: Connection, run_id: str, protocol_id: str, *, simulated: bool) -> Usage | None:
    """Return the usage of the newest other run of the protocol with photographs; None if there is none."""
    rows = connection.execute(
        text(
            "SELECT r.run_id FROM runs AS r JOIN event_facets AS f ON f.run_id = r.run_id AND f.seq = 1 "
            "WHERE f.name = 'protocol_id' AND f.value = :protocol AND r.simulated = :simulated AND r.run_id <> :run "
            "ORDER BY r.created_utc DESC LIMIT :most"
        ),
        {
            "simulated": int(simulated),
            "run": run_id,
            "protocol": facet_value(protocol_id),
            "most": _LOOKED_AT,
        },
    )
    usages = (read_usage(connection, row.run_id) for row in rows.all())
    return next((usage for usage in usages if usage.views), None)


def _helps(folder: Path) -> str:
    sizes = {words: _size(folder / name) for name, words in _REMOVABLE.items()}
    worth = [f"{words}: {size_words(size)}" for words, size in sizes.items() if size > _WORTH_SAYING_BYTES]
    inside = f". In the data folder you can delete {'; '.join(worth)}" if worth else ""
    return f"Move other files off this disk{inside}. Then try again; nothing that was captured is lost"


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else 0


# Find and remove what crashes left in the artefact folder, without harming a run in progress.
#
# A complete file without a row was either left by a crash before its record, or is about to be recorded by a living
# process. So a file stays if it is newer than the start of the oldest process that holds a run or a job, or younger
# than a minimum age, for processes that hold neither. Storing the same bytes again makes a file new
# (files.artefacts).


USUAL_AGE_S = 3600.0  # an import or export that has just begun holds no lease yet


@dataclass(frozen=True, slots=True)
class Leftover:
    """One file to which no record refers.

    Attributes:
        path: relative to the data folder.
        size_bytes: its size.
        written_utc: the time when it was last written or stored again.
        kind: `part` is an interrupted write, `unrecorded` a complete file that was never recorded.
        stays: the reason why it must not be removed now; "" if it may be.
    """

    path: str
    size_bytes: int
    written_utc: str
    kind: Literal["part", "unrecorded"]
    stays: str = ""


def leftovers(store: Store, *, min_age_s: float = USUAL_AGE_S) -> list[Leftover]:
    """Return every leftover, sorted by path; nothing is changed.

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
    """Return (path, time of last change in s UTC, size in bytes) of possible leftovers, sorted by path."""
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
    """Return how much farther UTC has gone on than the monotonic clock since the newest event, s; 0 if it has not.

    A file may be that much younger than it seems. Where the host was restarted since, this is 0 or makes files stay.
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
    """Return when a runner last began to work on the run, as it was recorded then; "" if none has."""
    started = (
        select(events.c.at_utc)
        .join(event_index, (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq))
        .where(event_index.c.run_id == run_id, event_index.c.kind == "session_started")
        .order_by(events.c.seq.desc())
        .limit(1)
    )
    return str(connection.execute(started).scalar() or "")
