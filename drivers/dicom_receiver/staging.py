"""Received files of series that are not complete: a series appears in the CT folder when its sender has finished."""

from __future__ import annotations

import errno
import os
import re
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import DeviceRefusedError, DeviceStorageFullError, DeviceUnavailableError

STAGING = ".receiving"  # hidden, so that the driver of the CT folder does not look into it
_UID = re.compile(r"[0-9](?:[0-9.]{0,62}[0-9])?")
_MISSING = ".missing"  # ends the name of a mark: this file was sent and could not be stored
_AGAIN = "Send the whole series again; the files that are here already count"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Holds what became of a series when an association ended."""

    series: str
    files: int  # of it, up to now
    delivered: bool
    words: str


class Staging:
    """Keeps files by series until no association that carries the series is open and none of them broke off.

    Half a series looks like a whole, shorter one. So what came before a break is held back, also over a restart,
    until another association brings the series and ends as it should; the series then has the files of both.
    """

    def __init__(self, folder: Path, reserve_bytes: int) -> None:
        """Take the CT folder, and the space that stays free on its disk.

        Raises DeviceUnavailableError if files cannot be written there.
        """
        self._folder, self._reserve = folder, reserve_bytes
        self._root = folder / STAGING
        self._lock = threading.Lock()
        self._carried: dict[str, set[str]] = {}  # by association: the series of which it brought files
        self._open: dict[str, set[str]] = {}  # by series: the associations that carry it and have not ended
        self._broken: set[str] = set()
        self._refused: set[str] = set()  # associations with files that cannot be read; of which series is not known
        self._incomplete: set[str] = set()  # series that such an association brought
        self._missed: dict[str, set[str]] = {}  # by series: files that could not be stored, where no mark could be
        try:
            self._root.mkdir(parents=True, exist_ok=True)
            for part in self._root.glob("*/*.part"):
                part.unlink()
        except OSError as error:
            raise DeviceUnavailableError(
                f"files cannot be written there ({error.strerror})",
                where=str(folder),
                remedy="Check the folder and its permissions",
            ) from error

    def held(self) -> tuple[Outcome, ...]:
        """The series that are held back from earlier, broken associations."""
        with self._lock:
            found = sorted(
                path.name for path in self._root.iterdir() if path.is_dir() and path.name not in self._open
            )
            return tuple(self._hold(series, "they came before this program began") for series in found)

    def store(self, association: str, series: str, instance: str, data: bytes) -> None:
        """Keep one file, on the disk when this returns.

        Raises:
            DeviceRefusedError: a UID is none, or another file of this UID came before.
            DeviceStorageFullError: the disk is full, or nearly.
        """
        for uid in (series, instance):
            if not _UID.fullmatch(uid):
                self.refuse(association)
                raise DeviceRefusedError(f"{uid[:80]!r} is not a UID", where=association, remedy="Send a valid file")
        with self._lock:
            self._carried.setdefault(association, set()).add(series)
            self._open.setdefault(series, set()).add(association)
        target = self._root / series / f"{instance}.dcm"
        for known in (target, self._folder / series / target.name):
            if known.is_file():
                if known.read_bytes() == data:
                    return
                raise DeviceRefusedError(
                    "another file with this UID came before",
                    where=str(known),
                    remedy="Remove that file and send again",
                )
        try:
            self._write(target, data)
        except OSError as error:
            self._miss(series, instance)
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise DeviceRefusedError(
                    f"the file cannot be written ({error.strerror})", where=str(target), remedy="Check the folder"
                ) from error
            raise DeviceStorageFullError(
                f"the disk is full: {instance} was not stored",
                where=str(self._folder),
                remedy="Free space, then send the series again",
            ) from error
        with self._lock:
            self._missed.get(series, set()).discard(instance)

    def refuse(self, association: str) -> None:
        """Note that a file cannot be read. It may be of any series that its association brings."""
        with self._lock:
            self._refused.add(association)

    def ended(self, association: str, *, released: bool) -> tuple[Outcome, ...]:
        """Deliver or hold the series of an association that ended, if no other one carries them.

        Args:
            association: its name.
            released: it ended as it should; False: it was aborted, or the connection broke.

        Raises:
            DeviceRefusedError: a whole series cannot be moved to its place.
        """
        with self._lock:
            found: list[Outcome] = []
            carried = self._carried.pop(association, set())
            if association in self._refused:
                self._refused.discard(association)
                self._incomplete |= carried
            for series in sorted(carried):
                others = self._open[series] - {association}
                if not released:
                    self._broken.add(series)
                if others:
                    self._open[series] = others
                    continue
                del self._open[series]
                found.append(self._finish(series))
            return tuple(found)

    def _finish(self, series: str) -> Outcome:
        broken, incomplete = series in self._broken, series in self._incomplete
        self._broken.discard(series)
        self._incomplete.discard(series)
        missing = len(self._missed_of(series))
        if broken:
            return self._hold(series, "the connection ended before the sender had finished")
        if missing:
            return self._hold(series, f"{missing} more could not be stored")
        if incomplete:
            return self._hold(series, "a file that came with them was refused")
        return self._deliver(series)

    def _hold(self, series: str, why: str) -> Outcome:
        count = len(self._files(series))
        return Outcome(
            series,
            count,
            delivered=False,
            words=f"series {series}: {count} files are held back, because {why}, and half a series looks like a "
            f"whole, shorter one. {_AGAIN}",
        )

    def _deliver(self, series: str) -> Outcome:
        source, target = self._root / series, self._folder / series
        try:
            if source.is_dir() and not target.exists():
                source.rename(target)
            else:
                for path in self._files(series):
                    path.replace(target / path.name)
                if source.is_dir():
                    source.rmdir()
            for place in (target, self._folder):
                _sync(place)
        except OSError as error:
            raise DeviceRefusedError(
                f"the series cannot be moved to its place ({error.strerror}); its files are in {source}",
                where=str(target),
                remedy="Check the folder, then send the series again",
            ) from error
        count = len(list(target.glob("*.dcm")))
        return Outcome(series, count, delivered=True, words=f"series {series}: {count} files are in {target}")

    def _files(self, series: str) -> list[Path]:
        return sorted((self._root / series).glob("*.dcm"))

    def _missed_of(self, series: str) -> set[str]:
        marks = {path.name.removesuffix(_MISSING) for path in (self._root / series).glob(f"*{_MISSING}")}
        return marks | self._missed.get(series, set())

    def _miss(self, series: str, instance: str) -> None:
        with self._lock:
            self._missed.setdefault(series, set()).add(instance)
        try:
            (self._root / series).mkdir(exist_ok=True)
            (self._root / series / f"{instance}{_MISSING}").touch()
        except OSError:  # then it is remembered only while this program runs
            pass

    def _write(self, target: Path, data: bytes) -> None:
        if shutil.disk_usage(self._folder).free < len(data) + self._reserve:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        target.parent.mkdir(exist_ok=True)
        part = target.with_suffix(f".{threading.get_ident()}.part")
        try:
            with part.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        except OSError:
            part.unlink(missing_ok=True)
            raise
        _sync(target.parent)
        target.with_suffix(_MISSING).unlink(missing_ok=True)


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
