"""The uploader: brings every recorded file into the object store, and records what the store confirms.

It is beside every capture and never in its way: no request is sent within a transaction, and nothing waits for it.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from service.core.errors import IntegrityError, StoreError
from service.core.text.words import counted
from service.store.artefacts import relative_path
from service.store.data_folder import object_store_of
from service.store.durable_effects import utc_text
from service.store.objects.anchors import AnchorWriter
from service.store.objects.copies import Recorded, Waiting, next_waiting, read_waiting, write_confirmed
from service.store.objects.interface import ObjectStore, ObjectStoreAwayError, ObjectStoreError
from service.store.store import Store

_LOG = logging.getLogger(__name__)
_AT_ONCE = 16  # files between two transactions
_IDLE_S = 5.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
_AGAIN_S = 600.0  # a file that was refused is tried again after so long
STATE = Path("monitor", "upload.json")
_LOCK = Path("monitor", "upload.lock")


@dataclass(frozen=True, slots=True)
class UploadTrouble:
    """Why nothing is uploaded at present, and since when; it is shown, and is no evidence."""

    since_utc: str
    what: str


class Uploader:
    """Drains the spool of one data folder into its object store."""

    def __init__(self, store: Store, objects: ObjectStore, anchors: AnchorWriter | None = None) -> None:
        self._store = store
        self._objects = objects
        self._anchors = anchors
        self._data = store.database_path.parent
        self._bucket_found = False
        self.refused: dict[str, str] = {}  # file → why it stays in the spool

    def drain(self, stopped: Callable[[], bool] = lambda: False) -> int:
        """Anchor what was signed and upload what waits, each file once. Returns how many files were confirmed.

        `refused` says which were not. Raises ObjectStoreError if the store is away or refuses everything; what was
        confirmed by then is recorded. Anchors that are refused keep no file waiting: that is raised at the end.
        """
        if not self._bucket_found:
            self._objects.require_bucket()
            self._bucket_found = True
        done, unanchored = 0, self._anchor(stopped)
        while not stopped():
            with self._store.database.reading() as connection:
                waiting = next_waiting(connection, self._objects.place, list(self.refused), _AT_ONCE)
            if not waiting:
                break
            confirmed: list[Recorded] = []
            try:
                for file in waiting:
                    if stopped():
                        break
                    why = self._upload(file)
                    if why:
                        self.refused[file.sha256] = why
                        _LOG.error("a file is not in the object store: %s", why, extra={"sha256": file.sha256})
                    else:
                        confirmed.append(file)
            finally:
                write_confirmed(self._store, self._objects.place, confirmed, utc_text(self._store.clock.utc_now()))
            done += len(confirmed)
            unanchored = self._anchor(stopped)
        if unanchored is not None:
            raise unanchored
        return done

    def _anchor(self, stopped: Callable[[], bool]) -> StoreError | None:
        """Anchor what was signed since; returns what forbids it. Raises ObjectStoreAwayError."""
        if self._anchors is None:
            return None
        try:
            self._anchors.write(stopped)
        except ObjectStoreAwayError:
            raise
        except StoreError as error:
            _LOG.error("the evidence is not anchored: %s", error.what)
            return error
        if self._anchors.beyond:
            lines = counted(self._anchors.beyond, "line")
            return StoreError(
                f"the object store holds anchors of {lines} that the log of signatures does not have",
                where=self._objects.place,
                remedy="It was rolled back: keep the data folder as it is, and run `orthocapture audit verify all`",
            )
        return None

    def _upload(self, file: Recorded) -> str:
        """Bring one file into the store. Returns "" once the store has confirmed it, else why it has not.

        Raises ObjectStoreError.
        """
        path = self._store.artefact_folder / relative_path(file.sha256)
        try:
            if path.is_file():
                self._objects.put_if_absent(file.sha256, path)
            stated = self._objects.stat(file.sha256)
        except ObjectStoreError:
            raise
        except (IntegrityError, StoreError) as error:
            return str(error)
        if stated is None:
            return "neither the spool nor the object store has it"
        if not stated.sha256:
            return "the object store states no SHA-256 of it"
        if (stated.sha256, stated.size_bytes) != (file.sha256, file.size_bytes):
            return f"the object store holds other content under its name: SHA-256 {stated.sha256}"
        return ""

    def follow(self, stopped: Callable[[], bool]) -> None:
        """Upload whatever is recorded, until `stopped`. Faults are retried with growing pauses and end nothing."""
        pause_s, clock, since = _FIRST_PAUSE_S, self._store.clock, ""
        refused_s = clock.monotonic_s()
        while not stopped():
            try:
                with alone(self._data) as mine:
                    if mine:
                        self.drain(stopped)
                wait_s, pause_s = _IDLE_S, _FIRST_PAUSE_S
                if since:
                    _LOG.info("the object store answers again")
                    since = ""
                    write_trouble(self._data, None)
            except StoreError as error:
                if not since:
                    since = utc_text(clock.utc_now())
                    kind = logging.WARNING if isinstance(error, ObjectStoreAwayError) else logging.ERROR
                    _LOG.log(kind, "nothing is uploaded: %s", error.what)
                write_trouble(self._data, UploadTrouble(since, error.what))
                wait_s, pause_s = pause_s, min(2 * pause_s, _LONGEST_PAUSE_S)
            if clock.monotonic_s() - refused_s > _AGAIN_S:
                self.refused.clear()
                refused_s = clock.monotonic_s()
            end_s = clock.monotonic_s() + wait_s
            while not stopped() and clock.monotonic_s() < end_s:
                clock.sleep(0.2)


@contextmanager
def alone(data_dir: Path) -> Generator[bool]:
    """Say whether this is the only uploader of a data folder meanwhile; a second one would only send twice."""
    (data_dir / _LOCK).parent.mkdir(exist_ok=True)
    descriptor = os.open(data_dir / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def write_trouble(data_dir: Path, trouble: UploadTrouble | None) -> None:
    """Say beside the record why nothing is uploaded, or that nothing hinders it."""
    path = data_dir / STATE
    path.parent.mkdir(exist_ok=True)
    if trouble is None:
        path.unlink(missing_ok=True)
        return
    part = path.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(asdict(trouble)))
    part.replace(path)


def read_trouble(data_dir: Path) -> UploadTrouble | None:
    """Return why nothing is uploaded; None if nothing hinders it, or nobody has tried."""
    try:
        found = json.loads((data_dir / STATE).read_text("utf-8"))
        return UploadTrouble(str(found["since_utc"]), str(found["what"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True, slots=True)
class UploadState:
    """The files that wait for the site's object store, and the trouble that hinders their upload, if any does."""

    waiting: Waiting
    trouble: UploadTrouble | None

    @property
    def sentence(self) -> str:
        """The same as a sentence for people."""
        if self.trouble is None:
            return self.waiting.sentence
        since = self.trouble.since_utc[:16].replace("T", " ")
        return f"{self.waiting.sentence}; trouble since {since} UTC: {self.trouble.what}"


def upload_state(store: Store) -> UploadState | None:
    """Return the state of the uploads of a data folder; None without an object store. Raises ConfigurationError."""
    data_dir = store.database_path.parent
    section = object_store_of(data_dir)
    if section is None:
        return None
    with store.database.reading() as connection:
        waiting = read_waiting(connection, section.place)
    return UploadState(waiting, read_trouble(data_dir))
