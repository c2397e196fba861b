"""Frees files of the spool, the artefact folder, that the object store holds and nobody needs here."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from sqlalchemy import Connection, select

from service.core.errors import StoreError
from service.store import jobs as queue
from service.store.artefacts import alone_with, relative_path
from service.store.database.tables import artefacts, copies
from service.store.durable_effects import utc_text
from service.store.objects.copies import Recorded, write_confirmed
from service.store.objects.interface import ObjectStore
from service.store.records import SITE
from service.store.runs import held_runs, read_open_runs
from service.store.site import SpoolSection
from service.store.store import Store

_LOG = logging.getLogger(__name__)
_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class SpoolFile:
    """A recorded file in the spool.

    Attributes:
        path: relative to the data folder.
        sha256: its hash.
        size_bytes: its size.
        stays: the reason why it must not be freed now; "" if it may be.
    """

    path: str
    sha256: str
    size_bytes: int
    stays: str = ""


def spool_files(store: Store, place: str, spool: SpoolSection) -> list[SpoolFile]:
    """Return every recorded file in the spool, and why it stays, if it must. Raises StoreError; nothing is sent."""
    with store.database.reading() as connection:
        used = _runs_of_files(connection)
        confirmed = set(connection.execute(select(copies.c.sha256).where(copies.c.place == place)).scalars())
        needed = dict.fromkeys(read_open_runs(connection), "its run has not ended")
        needed |= dict.fromkeys(held_runs(connection, store.clock), "a process drives its run")
        every_run = {run for runs in used.values() for run in runs}
        working = [run for run in every_run if queue.open_jobs(connection, run, None)]
        needed |= dict.fromkeys(working, "a job of its run is open")
        needed[SITE] = "it belongs to the site itself"
    found: list[SpoolFile] = []
    for sha256, runs in sorted(used.items()):
        path = store.artefact_folder / relative_path(sha256)
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        shown = str(Path(store.artefact_folder.name) / relative_path(sha256))
        reasons = [needed[run] for run in sorted(runs) if run in needed]
        age_s = store.clock.utc_s() - max(status.st_mtime, status.st_ctime)
        if sha256 not in confirmed:
            reasons.insert(0, "the object store has not confirmed it")
        elif spool.free_after_days and age_s < _DAY_S * spool.free_after_days:
            reasons.insert(0, f"it is younger than {spool.free_after_days:g} days")
        found.append(SpoolFile(shown, sha256, status.st_size, reasons[0] if reasons else ""))
    return found


def _runs_of_files(connection: Connection) -> dict[str, set[str]]:
    used: dict[str, set[str]] = {}
    for row in connection.execute(select(artefacts.c.sha256, artefacts.c.run_id).distinct()):
        used.setdefault(str(row.sha256), set()).add(str(row.run_id))
    return used


def free_spool(
    store: Store, objects: ObjectStore, spool: SpoolSection, only: Collection[str] | None = None
) -> list[SpoolFile]:
    """Free what may be freed, and return all of it that was looked at, each with the reason why it stays, if it does.

    Before each file goes, the store must state its hash once more. The folder is locked only while the file is
    removed, so that no capture waits for the network. Raises ObjectStoreError and StoreError; what was freed by then
    stays freed.
    """
    judged: list[SpoolFile] = []
    for file in spool_files(store, objects.place, spool):
        if only is not None and file.sha256 not in only:
            continue
        judged.append(file if file.stays else _free(store, objects, file))
    return judged


def _free(store: Store, objects: ObjectStore, file: SpoolFile) -> SpoolFile:
    path = store.artefact_folder / relative_path(file.sha256)
    try:
        before = path.stat()
        stated = objects.stat(file.sha256)
        if stated is None or (stated.sha256, stated.size_bytes) != (file.sha256, before.st_size):
            _LOG.error("the object store does not state any more what it confirmed", extra={"sha256": file.sha256})
            return replace(file, stays="the object store does not state its hash any more")
        at_utc = utc_text(store.clock.utc_now())
        write_confirmed(store, objects.place, [Recorded(file.sha256, file.size_bytes)], at_utc)
        with alone_with(store.artefact_folder):
            now = path.stat()
            if (now.st_mtime_ns, now.st_ctime_ns, now.st_size) != (
                before.st_mtime_ns,
                before.st_ctime_ns,
                before.st_size,
            ):
                return replace(file, stays="it was stored again meanwhile")
            store.files.remove(path)
    except OSError as error:
        raise StoreError(
            f"a file of the spool cannot be freed: {error.strerror or error}",
            where=str(path),
            remedy="Check the permissions of the data folder; nothing was lost",
        ) from error
    _LOG.info("freed from the spool; the object store holds it", extra={"sha256": file.sha256})
    return file
