"""The spool: which artefacts the object store has confirmed, how much waits, since when, and what may be freed.

The uploader counts now and then and writes the figures beside the record, so that a page adds only what was recorded
since, and never reads all artefacts of a site. None of it is evidence.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from sqlalchemy import Connection, func, insert, select, text, update

from service.core.disk_space import LEAST_FREE_BYTES
from service.core.errors import StoreError
from service.core.units import gigabytes
from service.core.words import counted
from service.store import jobs as queue
from service.store.artefacts import alone_with, relative_path
from service.store.data_folder import object_store_of
from service.store.database.tables import artefacts, copies, event_index
from service.store.durable_effects import utc_text
from service.store.objects.interface import ObjectStore
from service.store.records import SITE
from service.store.runs import held_runs, read_open_runs
from service.store.site import SpoolSection
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recorded file.

    Attributes:
        sha256: its hash.
        size_bytes: its size.
        position: the position of the event that brought it among all events; 0 if it does not matter.
    """

    sha256: str
    size_bytes: int
    position: int = 0


@dataclass(frozen=True, slots=True)
class Waiting:
    """The files that an object store has not confirmed yet, in figures.

    Attributes:
        files: how many files wait.
        size_bytes: their size.
        since_utc: when the oldest of them was recorded; "" if none waits.
        confirmed: how many files the store has confirmed.
    """

    files: int
    size_bytes: int
    since_utc: str
    confirmed: int

    @property
    def sentence(self) -> str:
        """The same as a sentence for people."""
        if not self.files:
            return f"all {counted(self.confirmed, 'file')} are in the object store"
        waits = "waits" if self.files == 1 else "wait"
        return (
            f"{counted(self.files, 'file')} ({gigabytes(self.size_bytes):.2f} GB) {waits} for the object store since "
            f"{self.since_utc[:16].replace('T', ' ')} UTC; {self.confirmed} are there"
        )


# CROSS JOIN: SQLite then reads the index of events first, from `after` on, and not every artefact.
_FROM = """
FROM event_index AS e CROSS JOIN artefacts AS a
WHERE e.position > :after AND a.run_id = e.run_id AND a.seq = e.seq
AND NOT EXISTS (SELECT 1 FROM copies AS c WHERE c.sha256 = a.sha256 AND c.place = :place)
"""
_SEEN_BEFORE = """
AND NOT EXISTS (
  SELECT 1 FROM artefacts AS b CROSS JOIN event_index AS f
  WHERE b.sha256 = a.sha256 AND f.run_id = b.run_id AND f.seq = b.seq AND f.position <= :after
)
"""
_FIGURES = text(
    "SELECT count(*) AS files, sum(size_bytes) AS size_bytes, min(at_utc) AS since_utc FROM ("
    f"SELECT max(a.size_bytes) AS size_bytes, min(a.at_utc) AS at_utc {_FROM} {_SEEN_BEFORE} GROUP BY a.sha256) AS w"
)
_ALL_FIGURES = text("""
SELECT count(*) AS files, sum(size_bytes) AS size_bytes, min(at_utc) AS since_utc FROM (
  SELECT max(a.size_bytes) AS size_bytes, min(a.at_utc) AS at_utc FROM artefacts AS a
  WHERE NOT EXISTS (SELECT 1 FROM copies AS c WHERE c.sha256 = a.sha256 AND c.place = :place)
  GROUP BY a.sha256
) AS w
""")
_NEXT = text(
    f"SELECT e.position AS place, a.sha256 AS sha256, a.size_bytes AS size_bytes {_FROM} "
    "ORDER BY e.position, a.position LIMIT :most"
)
_LATEST = text(
    "SELECT a.size_bytes AS size_bytes, a.at_utc AS at_utc FROM event_index AS e CROSS JOIN artefacts AS a "
    "WHERE e.position > :after AND a.run_id = e.run_id AND a.seq = e.seq ORDER BY e.position DESC LIMIT :most"
)
_LATEST_EVENTS, _LATEST_FILES = 20_000, 500  # among which the rate of recording is looked for
_SHORTEST_S = 60.0


def last_position(connection: Connection) -> int:
    """Return the position of the newest event of all chains; 0 if there is none."""
    return int(connection.execute(select(func.max(event_index.c.position))).scalar() or 0)


def count_confirmed(connection: Connection, place: str) -> int:
    """Return how many files a place has confirmed; this reads all of its rows."""
    return int(connection.execute(select(func.count()).where(copies.c.place == place)).scalar_one())


def is_confirmed(connection: Connection, place: str, sha256: str) -> bool:
    """Return whether a place has confirmed a file."""
    here = (copies.c.sha256 == sha256) & (copies.c.place == place)
    return connection.execute(select(copies.c.sha256).where(here)).first() is not None


def read_waiting(connection: Connection, place: str, after: int = 0, confirmed: int | None = None) -> Waiting:
    """Return what a place has not confirmed yet, in figures.

    Args:
        connection: a connection within a transaction.
        place: the name of the object store.
        after: position of an event: what was recorded up to it is left out, and so is later the same content.
        confirmed: how many files it has confirmed; None to count them, which reads all of their rows.
    """
    statement, values = (_FIGURES, {"after": after}) if after > 0 else (_ALL_FIGURES, {})
    row = connection.execute(statement, values | {"place": place}).one()
    there = count_confirmed(connection, place) if confirmed is None else confirmed
    return Waiting(int(row.files), int(row.size_bytes or 0), str(row.since_utc or ""), there)


def next_waiting(connection: Connection, place: str, after: int, but: Collection[str], most: int) -> list[Recorded]:
    """Return files recorded after an event that a place has not confirmed, the oldest first, without those named."""
    rows = connection.execute(_NEXT, {"after": after, "place": place, "most": most + len(but)})
    found: dict[str, Recorded] = {}
    for row in rows:
        if row.sha256 not in but:
            found.setdefault(row.sha256, Recorded(str(row.sha256), int(row.size_bytes), int(row.place)))
    return list(found.values())[:most]


def read_rate(connection: Connection, now: datetime) -> float:
    """Return the bytes a second that were recorded in the last hour, or since the first of its newest files; or 0."""
    values = {"after": last_position(connection) - _LATEST_EVENTS, "most": _LATEST_FILES}
    begin = utc_text(now - timedelta(hours=1))
    rows = [row for row in connection.execute(_LATEST, values) if row.at_utc >= begin]
    if not rows:
        return 0.0
    passed_s = (now - datetime.fromisoformat(str(rows[-1].at_utc))).total_seconds()
    return sum(int(row.size_bytes) for row in rows) / max(_SHORTEST_S, passed_s)


def write_confirmed(store: Store, place: str, confirmed: Sequence[Recorded], at_utc: str) -> int:
    """Record that a place has just stated these files, in a transaction of its own. Returns how many are new."""
    if not confirmed:
        return 0
    inserted = 0
    with store.database.writing() as connection:
        for file in confirmed:
            here = (copies.c.sha256 == file.sha256) & (copies.c.place == place)
            if connection.execute(update(copies).where(here).values(checked_utc=at_utc)).rowcount:
                continue
            new = {"sha256": file.sha256, "place": place, "size_bytes": file.size_bytes, "at_utc": at_utc}
            connection.execute(insert(copies).values(**new, checked_utc=at_utc))
            inserted += 1
    return inserted


STATE, LEVEL = Path("monitor", "upload.json"), Path("monitor", "spool.json")
_WORTH_SAYING_HOURS = 30 * 24.0  # a disk that lasts longer needs nobody's attention
_SILENT_S = 180.0  # an uploader that is at work writes more often


@dataclass(frozen=True, slots=True)
class UploadTrouble:
    """Why nothing is uploaded at present, and since when; it is shown, and is no evidence."""

    since_utc: str
    what: str


@dataclass(frozen=True, slots=True)
class CountedSpool:
    """The figures that an uploader counted.

    Attributes:
        place: the object store.
        at_utc: when it counted.
        drained: position of the event up to which everything is confirmed.
        counted: position of the event up to which the figures are.
        newest: the file that was confirmed last; "" if none was.
        waiting: the figures.
    """

    place: str
    at_utc: str
    drained: int
    counted: int
    newest: str
    waiting: Waiting


def write_counted(data_dir: Path, counted: CountedSpool) -> None:
    """Write what was counted beside the record."""
    _write(data_dir / LEVEL, json.dumps(asdict(counted)))


def read_counted(data_dir: Path, place: str) -> CountedSpool | None:
    """Return what an uploader counted last for this place; None if none did."""
    try:
        found = json.loads((data_dir / LEVEL).read_text("utf-8"))
        counted = CountedSpool(**(found | {"waiting": Waiting(**found["waiting"])}))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return counted if counted.place == place else None


def write_trouble(data_dir: Path, trouble: UploadTrouble | None) -> None:
    """Say beside the record why nothing is uploaded, or that nothing hinders it."""
    path = data_dir / STATE
    if trouble is None:
        path.unlink(missing_ok=True)
    else:
        _write(path, json.dumps(asdict(trouble)))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(text)
    part.replace(path)


def read_trouble(data_dir: Path) -> UploadTrouble | None:
    """Return why nothing is uploaded; None if nothing hinders it, or nobody has tried."""
    try:
        found = json.loads((data_dir / STATE).read_text("utf-8"))
        return UploadTrouble(str(found["since_utc"]), str(found["what"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True, slots=True)
class SpoolLevel:
    """How full the spool is.

    Attributes:
        waiting: the files that wait for the object store.
        trouble: the reason why they are not uploaded; None if nothing is known to hinder it.
        free_bytes: free space on the disk of the data folder.
        bytes_per_hour: how much is recorded in an hour, as of late.
        lasts_hours: how long the disk lasts at this rate; None if nothing was recorded of late.
    """

    waiting: Waiting
    trouble: UploadTrouble | None
    free_bytes: int
    bytes_per_hour: float
    lasts_hours: float | None

    @property
    def sentence(self) -> str:
        """The same as a sentence for people."""
        parts = [self.waiting.sentence]
        if self.trouble is not None:
            since = self.trouble.since_utc[:16].replace("T", " ")
            parts.append(f"trouble since {since} UTC: {self.trouble.what}")
        free = f"{gigabytes(self.free_bytes):.1f} GB are free on this disk"
        if self.lasts_hours is not None and self.lasts_hours < _WORTH_SAYING_HOURS:
            rate = f"{gigabytes(self.bytes_per_hour):.3g} GB an hour, as of late"
            free += f", which last {self.lasts_hours:.1f} hours at {rate}"
        return "; ".join([*parts, free])


def spool_level(store: Store) -> SpoolLevel | None:
    """Return how full the spool of a data folder is; None without an object store. Raises ConfigurationError."""
    data_dir = store.database_path.parent
    section = object_store_of(data_dir)
    if section is None:
        return None
    now = store.clock.utc_now()
    counted, trouble = read_counted(data_dir, section.place), read_trouble(data_dir)
    with store.database.reading() as connection:
        if counted is None or (counted.newest and not is_confirmed(connection, section.place, counted.newest)):
            counted, waiting = None, read_waiting(connection, section.place)
        else:
            waiting = _together(
                counted.waiting, read_waiting(connection, section.place, counted.counted, counted.waiting.confirmed)
            )
        per_hour = 3600.0 * read_rate(connection, now)
    if trouble is None and waiting.files:
        trouble = _silence(counted, waiting, now)
    free_bytes = store.free_bytes()
    lasts = max(0, free_bytes - LEAST_FREE_BYTES) / per_hour if per_hour else None
    return SpoolLevel(waiting, trouble, free_bytes, per_hour, lasts)


def _together(before: Waiting, since: Waiting) -> Waiting:
    begun = [text for text in (before.since_utc, since.since_utc) if text]
    files, size_bytes = before.files + since.files, before.size_bytes + since.size_bytes
    return Waiting(files, size_bytes, min(begun, default=""), before.confirmed)


def _silence(counted: CountedSpool | None, waiting: Waiting, now: datetime) -> UploadTrouble | None:
    """Return that no uploader is at work, if files have waited for long and none has counted them since."""
    since_utc = waiting.since_utc if counted is None else max(counted.at_utc, waiting.since_utc)
    try:
        silent_s = (now - datetime.fromisoformat(since_utc)).total_seconds()
    except ValueError:
        return None
    if silent_s < _SILENT_S:
        return None
    return UploadTrouble(since_utc, "no uploader is at work: start `orthocapture worker`")


_log = logging.getLogger(__name__)
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
            _log.error("the object store does not state any more what it confirmed", extra={"sha256": file.sha256})
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
    _log.info("freed from the spool; the object store holds it", extra={"sha256": file.sha256})
    return file
