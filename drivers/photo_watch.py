"""Driver for a camera without a cable, whose photographs arrive as files in a folder (memory card or transfer)."""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from pydantic import Field

from drivers.errors import (
    DeviceRefusedError,
    DeviceUnavailableError,
    ReleasedElsewhereError,
    StaleImageError,
    UnreadableFileError,
)
from drivers.folder_files import files_below
from drivers.interfaces import CameraSettings, CapturedFile, CapturedImage, DeviceIdentity, DeviceReport
from drivers.photos.photo_file import ExifRecord, check_jpeg_complete, read_exif, sha256_of, taken_utc_s
from drivers.photos.photo_folder import JPEG_SUFFIXES, RAW_MEDIA_TYPES, odd, paired
from drivers.plugin import DriverConfig, DriverSpec
from service.core.jpeg_damage import damaged_jpegs

_LOOK_S = 0.2  # interval between two polls of the folder
_COUNTER = re.compile(r"(\d+)$")


class PhotoWatchConfig(DriverConfig):
    """The camera's section in rig.yaml."""

    folder: Path = Field(description="where the card appears, or where the camera sends its files; may come later")
    stable_s: float = Field(default=2.0, ge=0, description="how long a file must stay unchanged; 10 s on a share")
    stalled_s: float = Field(default=60.0, gt=0, description="after this time an incomplete file counts as damaged")
    clock_ahead_s: float = Field(default=0.0, description="camera clock minus this computer's; negative: it is slow")


@dataclass(slots=True)
class _Seen:
    """The state of a file at the last poll."""

    size_bytes: int
    modified_ns: int
    since_s: float  # unchanged since this time, on the host's monotonic clock
    from_start: bool  # it was in the folder at the first poll
    exif: ExifRecord | None = None  # of a JPEG that could be read
    taken_s: float = 0.0  # seconds since 1970, by the host's clock
    whole: bool = False  # the JPEG is complete
    trouble: UnreadableFileError | None = None  # why it cannot be used
    done: bool = False  # returned or reported


class PhotoWatch:
    """drivers.interfaces.Camera on a folder, which it polls and reads but never changes.

    Each photograph, identified by its content, is returned once per `open`. While any file is still arriving, none is
    returned, so that the photographs of a card come in the order in which they were taken.
    """

    def __init__(
        self,
        config: PhotoWatchConfig,
        monotonic: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._config = config
        self._monotonic = monotonic
        self._sleep = sleep
        self._seen: dict[Path, _Seen] = {}
        self._raws: dict[Path, list[Path]] = {}  # of each JPEG
        self._alone: list[Path] = []  # raw files without one
        self._observing = False
        self._given: set[str] = set()
        self._wanted: CameraSettings | None = None

    # --- every device -----------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Start watching the folder, which need not exist yet: a card can be inserted later."""
        self._seen.clear()
        self._given.clear()
        self._observing = False
        self._observe()
        self._observing = True
        return self._identity()

    def close(self) -> None:
        """Do nothing: nothing is kept open."""

    def report(self) -> DeviceReport:
        """Return the watched folder and the number of files in it."""
        folder = self._config.folder
        there = folder.is_dir()
        return DeviceReport(
            identity=self._identity(),
            free_bytes=shutil.disk_usage(folder).free if there else None,
            details={"photographs_from": str(folder), "files": str(len(self._seen))},
            problems=() if there else (f"{folder} is not there yet: put the card in, or check the path in rig.yaml",),
        )

    # --- what only a camera on a cable can do -----------------------------------------------------------------

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Remember the settings, which a person dials in; each file's EXIF shows what the camera was set to."""
        self._wanted = settings
        return settings

    def settings(self) -> CameraSettings:
        """Raise DeviceRefusedError: the camera cannot be asked for its settings."""
        raise self._refusal("this camera cannot be asked for its settings: its photographs come as files")

    def preview(self) -> bytes:
        """Raise DeviceRefusedError: the camera has no live view."""
        raise self._refusal("this camera has no live view on the screen: its photographs come as files")

    def capture(self, folder: Path) -> CapturedImage:
        """Raise ReleasedElsewhereError: only the camera's own button releases its shutter."""
        raise ReleasedElsewhereError(
            "the software cannot release this camera: its photographs come as files",
            where=str(self._config.folder),
            remedy="Press the camera's own button; where the software must release, connect a camera by its cable",
        )

    # --- photographs ------------------------------------------------------------------------------------------

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Copy new photographs into `folder` and return them in the order of their EXIF times.

        Waits up to `timeout_s` for the first one. Photographs taken before `since_utc_s` (seconds since 1970) are
        ignored.

        Raises:
            UnreadableFileError: once for each file that cannot be used.
            StaleImageError: once for photographs that arrived since `open` but were taken before `since_utc_s`.
        """
        deadline_s = self._monotonic() + timeout_s
        while True:
            self._observe()
            arriving = [path for path in self._seen if self._arrives(path, since_utc_s)]
            images = () if arriving else self._hand_over(folder, since_utc_s)
            if images:
                return images
            self._raise_trouble(since_utc_s)
            left_s = deadline_s - self._monotonic()
            if left_s <= 0:
                return ()
            self._sleep(min(_LOOK_S, left_s))

    def _observe(self) -> None:
        """Poll the folder: update which files it holds and since when they are unchanged."""
        root, now_s = self._config.folder, self._monotonic()
        try:
            paths = [path for path in files_below(root) if _is_photograph(path) and not odd(path, root)]
        except DeviceUnavailableError:
            paths = []  # the card is still in the camera
        before, self._seen = self._seen, {}
        for path in paths:
            try:
                stat = path.stat()
            except OSError:
                continue  # it has gone since the folder was listed
            seen = before.get(path)
            if seen is None or (seen.size_bytes, seen.modified_ns) != (stat.st_size, stat.st_mtime_ns):
                from_start = not self._observing if seen is None else seen.from_start
                seen = _Seen(stat.st_size, stat.st_mtime_ns, now_s, from_start)
            self._seen[path] = seen
        jpegs = [path for path in self._seen if _is_jpeg(path)]
        self._raws, self._alone = paired(jpegs, [path for path in self._seen if not _is_jpeg(path)])

    def _arrives(self, path: Path, since_utc_s: float) -> bool:
        """Say whether this photograph is still arriving: its file changes, is incomplete, or lacks its raw file."""
        seen = self._seen[path]
        waited_s = self._monotonic() - seen.since_s
        if seen.done:
            return False
        if waited_s < self._config.stable_s:
            return True
        if not _is_jpeg(path):
            return False
        if not seen.whole and seen.trouble is None:
            self._read(path, seen, since_utc_s)
        if waited_s >= self._config.stalled_s or self._is_older(seen, since_utc_s):
            return False
        if seen.whole:
            raw_wanted = self._wanted is not None and self._wanted.image_quality == "RAW+JPEG"
            return raw_wanted and seen.trouble is None and not self._raws.get(path)
        return True

    def _read(self, path: Path, seen: _Seen, since_utc_s: float) -> None:
        """Read the EXIF of a JPEG that has stopped changing, and check the file unless it is older than wanted."""
        try:
            seen.exif = read_exif(path)
            taken_s = taken_utc_s(seen.exif.taken)
            seen.taken_s = float("inf") if taken_s is None else taken_s - self._config.clock_ahead_s
            if self._is_older(seen, since_utc_s):
                return
            check_jpeg_complete(path)
            seen.whole = True
            damage = damaged_jpegs([path]).get(path)
            if damage is not None:
                seen.trouble = UnreadableFileError(
                    damage, where=str(path), remedy="Copy it from the card again, or take it again"
                )
                return
            seen.exif.settings(focus_mode="", image_quality="")
            if taken_s is None:
                seen.trouble = UnreadableFileError(
                    "the photograph does not state when it was taken",
                    where=str(path),
                    remedy="Use files as they left the camera; editing programs often remove EXIF",
                )
        except UnreadableFileError as error:
            seen.trouble = error
        except OSError as error:
            seen.trouble = UnreadableFileError(
                f"the photograph cannot be read ({error.strerror})", where=str(path), remedy="Put the card in again"
            )

    @staticmethod
    def _is_older(seen: _Seen, since_utc_s: float) -> bool:
        return seen.exif is not None and seen.taken_s < since_utc_s

    def _hand_over(self, folder: Path, since_utc_s: float) -> tuple[CapturedImage, ...]:
        """Copy all usable photographs, in the order in which they were taken."""
        ready = [
            (seen.taken_s, path)
            for path, seen in self._seen.items()
            if seen.whole and not seen.done and seen.trouble is None and not self._is_older(seen, since_utc_s)
        ]
        images = [self._copied(path, Path(tempfile.mkdtemp(dir=folder))) for _, path in sorted(ready)]
        return tuple(image for image in images if image is not None)

    def _copied(self, path: Path, folder: Path) -> CapturedImage | None:
        """Copy the files of one photograph; None if it was returned before, or the card was removed meanwhile."""
        seen = self._seen[path]
        assert seen.exif is not None
        try:
            files = tuple(_copy(one, folder, self._seen[one]) for one in (path, *self._raws.get(path, ())))
        except OSError:
            seen.since_s = self._monotonic()  # retried once it has been stable again
            return None
        seen.done = True
        if files[0].sha256 in self._given:
            return None
        self._given.add(files[0].sha256)
        exif, arrival_s = seen.exif, self._monotonic()
        counter = _COUNTER.search(path.stem)
        quality = "RAW+JPEG" if len(files) > 1 else "JPEG"
        return exif.exposure_of(
            files,
            int(counter[1]) if counter else 0,
            exif.settings(focus_mode=exif.focus_mode, image_quality=quality),
            trigger_monotonic_s=arrival_s,
            arrival_monotonic_s=arrival_s,
            found_at=str(path),
        )

    # --- what cannot be used --------------------------------------------------------------------------------------

    def _raise_trouble(self, since_utc_s: float) -> None:
        now_s = self._monotonic()
        for seen in self._seen.values():
            if seen.trouble and not seen.done and (seen.whole or now_s - seen.since_s >= self._config.stalled_s):
                seen.done = True
                raise seen.trouble
        old = {path: seen for path, seen in self._seen.items() if self._is_older(seen, since_utc_s) and not seen.done}
        for seen in old.values():
            seen.done = True
        alone = [path for path in self._alone if now_s - self._seen[path].since_s >= self._config.stalled_s]
        new = [path for path in alone if not (self._seen[path].from_start or self._seen[path].done)]
        for path in new:
            self._seen[path].done = True
        if new:
            raise UnreadableFileError(
                f"{new[0].name} and {len(new) - 1} more are raw files without the JPEG of the same name",
                where=str(self._config.folder),
                remedy="Set the camera to JPEG, or to RAW and JPEG, and take the photographs again",
            )
        told = [path for path, seen in old.items() if not seen.from_start]
        if told:
            newest = max(told, key=lambda path: old[path].taken_s)
            exif = old[newest].exif
            assert exif is not None
            raise StaleImageError(
                f"{len(told)} photographs are left out, taken before this step began: the newest, {newest.name}, at "
                f"{exif.taken} by the camera's clock",
                where=str(self._config.folder),
                remedy="If they belong to this step the camera's clock is slow: set it and take them again",
            )

    def _refusal(self, what: str) -> DeviceRefusedError:
        return DeviceRefusedError(
            what, where=str(self._config.folder), remedy="Look at the camera; or connect one by its cable"
        )

    def _identity(self) -> DeviceIdentity:
        return DeviceIdentity(
            kind="camera",
            model="any, by its files",  # each photograph names the body that took it
            serial="",
            firmware="",
            driver="photo_folder",
            driver_version=f"exiv2 {version('exiv2')}",
            address=str(self._config.folder),
        )


def _copy(path: Path, folder: Path, seen: _Seen) -> CapturedFile:
    """Copy a file into `folder`. Raises OSError if it has changed since it was seen."""
    target = folder / path.name
    shutil.copyfile(path, target)
    stat = path.stat()
    if (target.stat().st_size, stat.st_mtime_ns) != (seen.size_bytes, seen.modified_ns):
        raise OSError(f"{path.name} changed while it was copied")
    media_type = "image/jpeg" if _is_jpeg(path) else RAW_MEDIA_TYPES[path.suffix.lower()]
    return CapturedFile(target, path.name, sha256_of(target), seen.size_bytes, media_type)


def _is_jpeg(path: Path) -> bool:
    return path.suffix.lower() in JPEG_SUFFIXES


def _is_photograph(path: Path) -> bool:
    return _is_jpeg(path) or path.suffix.lower() in RAW_MEDIA_TYPES


def _build(config: PhotoWatchConfig) -> PhotoWatch:
    return PhotoWatch(config)


DRIVER = DriverSpec(kind="camera", config=PhotoWatchConfig, build=_build)
