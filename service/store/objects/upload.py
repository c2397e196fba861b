"""The uploader: brings every recorded file into the object store, and records what the store confirms.

It is beside every capture and never in its way: no request is sent within a transaction, and nothing waits for it.
"""

from __future__ import annotations

import fcntl
import logging
import os
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.core.errors import IntegrityError, StoreError
from service.core.words import counted
from service.store.artefacts import relative_path
from service.store.durable_effects import utc_text
from service.store.objects.anchors import AnchorWriter
from service.store.objects.interface import ObjectStore, ObjectStoreAwayError, ObjectStoreError
from service.store.objects.spool import (
    CountedSpool,
    Recorded,
    UploadTrouble,
    count_confirmed,
    is_confirmed,
    last_position,
    next_waiting,
    read_counted,
    read_waiting,
    write_confirmed,
    write_counted,
    write_trouble,
)
from service.store.store import Store

_log = logging.getLogger(__name__)
_AT_ONCE = 16  # files between two transactions
_IDLE_S = 5.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
_COUNT_AGAIN_S, _STILL_HERE_S = 2.0, 60.0  # the pages are told so often, also that nothing has changed
_MOST_UNCOUNTED = 500  # events after which the pages are told where to go on
_AGAIN_S = 600.0  # a file that was refused is tried again after so long
_LOCK = Path("monitor", "upload.lock")


class Uploader:
    """Drains the spool of one data folder into its object store."""

    def __init__(self, store: Store, objects: ObjectStore, anchors: AnchorWriter | None = None) -> None:
        self._store = store
        self._objects = objects
        self._anchors = anchors
        self._data = store.database_path.parent
        self._bucket_found = False
        self._begun = False
        self._after = 0  # position of the event up to which every file is confirmed or refused
        self._places: dict[str, int] = {}  # refused file → position of the event that brought it
        self._newest, self._confirmed = "", 0
        self._counted: CountedSpool | None = None
        self._count_s, self._count_again_s = 0.0, 0.0
        self.refused: dict[str, str] = {}  # file → why it stays in the spool

    def drain(self, stopped: Callable[[], bool] = lambda: False) -> int:
        """Anchor what was signed and upload what waits, each file once. Returns how many files were confirmed.

        `refused` says which were not. Raises ObjectStoreError if the store is away or refuses everything; what was
        confirmed by then is recorded. Anchors that are refused keep no file waiting: that is raised at the end.
        """
        self._begin()
        done = 0
        try:
            if not self._bucket_found:
                self._objects.require_bucket()
                self._bucket_found = True
            unanchored = self._anchor(stopped)
            while not stopped():
                with self._store.database.reading() as connection:
                    until = last_position(connection)
                    waiting = next_waiting(connection, self._objects.place, self._after, self.refused, _AT_ONCE)
                done += self._upload_all(waiting, stopped)
                if not waiting:
                    self._after = until
                    break
                self._count()
                unanchored = self._anchor(stopped)
        finally:
            self._count(now=bool(done))
        if unanchored is not None:
            raise unanchored
        return done

    def _upload_all(self, waiting: Sequence[Recorded], stopped: Callable[[], bool]) -> int:
        """Upload files, the oldest first, and record what the store confirms. Raises ObjectStoreError."""
        confirmed: list[Recorded] = []
        try:
            for file in waiting:
                if stopped():
                    break
                why = self._upload(file)
                if why:
                    self.refused[file.sha256] = why
                    self._places[file.sha256] = file.position
                    _log.error("a file is not in the object store: %s", why, extra={"sha256": file.sha256})
                else:
                    confirmed.append(file)
                self._after = max(self._after, file.position - 1)  # the same event may have brought more
        finally:
            at_utc = utc_text(self._store.clock.utc_now())
            self._confirmed += write_confirmed(self._store, self._objects.place, confirmed, at_utc)
            self._newest = confirmed[-1].sha256 if confirmed else self._newest
        return len(confirmed)

    def _begin(self) -> None:
        """Go on where an uploader ended, if the rows of `copies` still fit; else begin at the first file."""
        if self._begun:
            return
        place, left = self._objects.place, read_counted(self._data, self._objects.place)
        with self._store.database.reading() as connection:
            self._confirmed = count_confirmed(connection, place)
            same = left is not None and left.waiting.confirmed <= self._confirmed
            if left is not None and same and (not left.newest or is_confirmed(connection, place, left.newest)):
                self._after, self._newest = left.drained, left.newest
        self._begun = True

    def _try_refused_again(self) -> None:
        self._after = min([self._after, *(place - 1 for place in self._places.values())])
        self.refused.clear()
        self._places.clear()

    def _count(self, *, now: bool = False) -> None:
        """Count what waits and write it for the pages, but for a twentieth of the time at most, unless `now`."""
        begun_s = self._store.clock.monotonic_s()
        if not now and begun_s < self._count_again_s:
            return
        place, drained = self._objects.place, min([self._after, *(at - 1 for at in self._places.values())])
        with self._store.database.reading() as connection:
            until = last_position(connection)
            waiting = read_waiting(connection, place, drained, self._confirmed)
        counted = CountedSpool(place, utc_text(self._store.clock.utc_now()), drained, until, self._newest, waiting)
        before = self._counted
        if (
            before is None
            or before.waiting != waiting
            or until - before.counted > _MOST_UNCOUNTED
            or begun_s > self._count_s + _STILL_HERE_S
        ):
            write_counted(self._data, counted)
            self._counted, self._count_s = counted, begun_s
        took_s = self._store.clock.monotonic_s() - begun_s
        self._count_again_s = begun_s + max(_COUNT_AGAIN_S, 20 * took_s)

    def _anchor(self, stopped: Callable[[], bool]) -> StoreError | None:
        """Anchor what was signed since; returns what forbids it. Raises ObjectStoreAwayError."""
        if self._anchors is None:
            return None
        try:
            self._anchors.write(stopped)
        except ObjectStoreAwayError:
            raise
        except StoreError as error:
            _log.error("the evidence is not anchored: %s", error.what)
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
                    _log.info("the object store answers again")
                    since = ""
                    write_trouble(self._data, None)
            except StoreError as error:
                if not since:
                    since = utc_text(clock.utc_now())
                    kind = logging.WARNING if isinstance(error, ObjectStoreAwayError) else logging.ERROR
                    _log.log(kind, "nothing is uploaded: %s", error.what)
                write_trouble(self._data, UploadTrouble(since, error.what))
                wait_s, pause_s = pause_s, min(2 * pause_s, _LONGEST_PAUSE_S)
            if clock.monotonic_s() - refused_s > _AGAIN_S:
                self._try_refused_again()
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
