"""The fill level of the spool: what waits for the object store, since when and why, and how long the disk lasts.

The uploader counts now and then and writes the figures beside the record, so that a page adds only what was recorded
since, and never reads all artefacts of a site. None of it is evidence.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from service.core.disk_space import LEAST_FREE_BYTES
from service.core.units import gigabytes
from service.store.data_folder import object_store_of
from service.store.objects.copies import Waiting, is_confirmed, read_rate, read_waiting
from service.store.store import Store

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
