"""The gphoto camera driver: settings with read-back, exposures with checked files, live view and health report."""

from __future__ import annotations

import logging
import re
import time
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from drivers.errors import (
    DeviceBusyError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    StaleImageError,
    UnreadableFileError,
)
from drivers.gphoto.dials import NOT_TOLD, Dials
from drivers.gphoto.link import AddedFile, Link, gp, library_version
from drivers.gphoto.listing import list_properties
from drivers.gphoto.profile import Profile, battery_fraction
from drivers.gphoto.profiles import profile_for
from drivers.gphoto.room import Room
from drivers.gphoto.shutter import release_again, release_shutter
from drivers.interfaces import (
    CameraSettings,
    CapturedFile,
    CapturedImage,
    DeviceAnswers,
    DeviceIdentity,
    DeviceReport,
)
from drivers.photos.photo_file import check_jpeg_complete, read_exif, sha256_of
from drivers.plugin import DriverConfig
from service.core.units import ms

_LOG = logging.getLogger(__name__)
PREVIEW_PATIENCE_S = 15.0
MEDIA_TYPES = {
    ".JPG": "image/jpeg",
    ".JPEG": "image/jpeg",
    ".ARW": "image/x-sony-arw",
    ".CR2": "image/x-canon-cr2",
    ".CR3": "image/x-canon-cr3",
    ".NEF": "image/x-nikon-nef",
}
# DCF: four free characters, which may be digits, and a number of four.
_NAME = re.compile(r"(?:capt_)?(?P<stem>\w*?(?P<counter>\d{1,4}))(?P<suffix>\.\w+)$")


class GphotoConfig(DriverConfig):
    """A camera in rig.yaml: `port` is ptpip:HOST:PORT:PORT, usb:BUS,DEVICE, or empty for the only camera on USB."""

    port: str = ""  # as libgphoto2 names it; usb: is the only camera on USB
    model: str = ""  # part of the model name, to choose among several cameras on USB
    profile: str = ""  # such as canon_eos; empty: chosen by the body's name
    # What the camera keeps the image on until it is fetched; without it, what the profile prefers.
    capture_target: Literal["computer", "card", "both"] | None = None
    white_balance: str = ""  # in the camera's words; empty: as it is set, or daylight if it is automatic
    capture_timeout_s: float = 40.0  # from the release to the file

    @property
    def longest_call_s(self) -> float:
        """Time for an exposure, plus a minute to download its files."""
        return self.capture_timeout_s + 60.0


class GphotoCamera:
    """drivers.interfaces.Camera over libgphoto2. Its calls block, so drivers.host runs it in a process of its own."""

    def __init__(self, config: GphotoConfig) -> None:
        self._config = config
        self._link = Link(config.port, config.model)
        self._identity: DeviceIdentity | None = None
        self._last: CapturedImage | None = None
        self._hashes: set[str] = set()
        self._clock_offset_s: float | None = None
        self._profile_name = ""
        self._target = ""
        self._has_released = False  # since it was opened
        self._opened: tuple[Profile, Dials] | None = None

    @property
    def _profile(self) -> Profile:
        return self._need()[0]

    @property
    def _dials(self) -> Dials:
        return self._need()[1]

    def _need(self) -> tuple[Profile, Dials]:
        if self._opened is None:
            raise DeviceUnavailableError("the camera is not open", where=self._link.where, remedy="Open it first")
        return self._opened

    # --- every device -----------------------------------------------------------------------------------

    def open(self) -> DeviceIdentity:
        """Connect or reconnect, set the capture target and return the camera's identity."""
        self._link.open()
        maker, model = self._link.value("manufacturer"), self._link.value("cameramodel")
        self._profile_name, profile = profile_for(maker, model, self._config.profile, self._link.where)
        self._opened = profile, Dials(self._link, profile, self._config.white_balance)
        self._target = self._choose_target()
        self._has_released = False
        self._identity = DeviceIdentity(
            kind="camera",
            model=model,
            serial=self._dials.serial(),
            firmware=self._link.value("deviceversion"),
            driver="gphoto",
            driver_version=f"python-gphoto2 {version('gphoto2')}, libgphoto2 {library_version()}",
            address=self._config.port or "usb",
        )
        return self._identity

    def _room(self) -> Room:
        return Room(self._link, self._profile, self._target)

    def _choose_target(self) -> str:
        """Set what the camera keeps the image on, and return it: as configured, else what the profile prefers."""
        wanted, profile, name = self._config.capture_target, self._profile, self._profile.target.name
        if wanted is not None and wanted not in profile.targets:
            raise DeviceRefusedError(
                f"capture_target {wanted} is not possible with the profile {self._profile_name}",
                where=self._link.where,
                remedy=f"Possible: {', '.join(profile.targets)}",
            )
        preferred = next(iter(profile.targets))
        if wanted is None:
            try:
                offered = self._link.choices(name)
            except DeviceRefusedError as error:  # bodies from before 2018 hand every photograph over
                _LOG.warning("the camera keeps photographs where its menu says: %s", error)
                return preferred
            wanted = next((ours for ours, word in profile.targets.items() if word in offered), preferred)
        self._dials.set(name, profile.targets[wanted])
        return wanted

    def close(self) -> None:
        """Disconnect from the camera; does not raise if the link is dead."""
        self._link.close()

    def report(self) -> DeviceReport:
        """Return battery, free space and settings; the clock offset comes from the EXIF time of the last exposure."""
        if self._identity is None:
            raise DeviceUnavailableError("the camera is not open", where=self._link.where, remedy="Open it first")
        profile = self._profile
        self._dials.refresh()
        free = self._room().free_bytes()
        battery = self._battery()
        names = (
            profile.f_number,
            profile.shutter,
            profile.iso,
            profile.focus,
            profile.quality,
            profile.white_balance,
        )
        told: dict[str, str] = {}
        silent: list[str] = []
        for one in names:
            try:
                told[one.name] = self._dials.word(one)
            except DeviceRefusedError as error:
                told[one.name] = NOT_TOLD
                silent.append(f"{error.what}: {error.remedy}")
        return DeviceReport(
            identity=self._identity,
            clock_offset_s=self._clock_offset_s,
            free_bytes=free,
            battery_fraction=battery,
            details={
                "profile": self._profile_name,
                **told,
                "serial number": "its photographs may state only the last digits",
            },
            problems=(*silent, *self._problems(battery, free)),
        )

    def answers(self) -> DeviceAnswers:
        """List all properties of the body, also of one that `open` refused."""
        return list_properties(self._link)

    def _battery(self) -> float | None:
        try:
            return battery_fraction(self._link.value("batterylevel"))
        except DeviceRefusedError as error:
            _LOG.info("the charge of the battery is unknown: %s", error)
            return None

    def _problems(self, battery: float | None, free: int | None) -> tuple[str, ...]:
        problems: list[str] = []
        if battery is not None and battery < 0.2:
            problems.append(f"Battery at {100 * battery:g} %: change it, or use mains power")
        try:
            program = self._link.value(self._profile.program.name)
            if program != self._profile.manual_program:
                problems.append(f"Exposure program is {program}: turn the mode dial to M")
        except DeviceRefusedError as error:
            problems.append(f"{error.what}: see that the mode dial is on M")
        problems += self._dials.wrong_by_hand()
        if full := self._room().problem(free):
            problems.append(f"{full}: empty, change or insert the card")
        return tuple(problems)

    # --- settings -----------------------------------------------------------------------------------------

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set each value to one that the camera currently offers, and return what reads back.

        Raises DeviceRefusedError if the camera does not offer a value or does not keep it.
        """
        return self._dials.apply(settings)

    def settings(self) -> CameraSettings:
        """Return the camera's current settings; drains events first, which clears libgphoto2's 2 s cache."""
        return self._dials.settings()

    # --- exposures -----------------------------------------------------------------------------------------

    def capture(self, folder: Path) -> CapturedImage:
        """Take one exposure and download its undecoded files into `folder`.

        In `exif`, aperture, exposure time and ISO come from the file; focus mode and quality, for which EXIF has no
        standard tag, come from the camera's settings.

        Raises:
            StaleImageError: a file that is not new.
            UnreadableFileError: a file that is incomplete or damaged.
            DeviceStorageFullError: no space left in the camera.
            DeviceTimeoutError: files that did not arrive in time.
            DeviceRefusedError, DeviceBusyError, DeviceUnavailableError: the shutter was not released.
        """
        dials = self._dials
        dials.refresh()
        for left in dials.announced:
            _LOG.warning("%s is left over from before and does not belong to this exposure", left.name)
        dials.announced.clear()
        quality, focus = dials.quality(), dials.focus()
        dials.word(
            self._profile.f_number
        )  # without a lens, or with one that states none, no photograph could be used
        room = self._room()
        room.check()
        trigger_s, *first = release_shutter(self._link, dials, partial(room.check, refused=True))
        if self._profile.may_miss_first and not (first or self._has_released):
            trigger_s, *first = release_again(self._link, dials, trigger_s, self._config.capture_timeout_s)
        added = self._collect(2 if quality == "RAW+JPEG" else 1, trigger_s, *first)
        self._has_released = True
        return self._image(added, folder, trigger_s, quality, focus)

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Download into `folder` the exposures released with the camera's button, oldest first.

        Waits up to `timeout_s` for the first one. The camera announces files as events; RAW and JPEG of one exposure
        form one image. `since_utc_s` is not needed, because announced files are always new.
        """
        announced = self._dials.announced
        deadline_s = time.monotonic() + timeout_s
        images: list[CapturedImage] = []
        while True:
            if announced:
                images.append(self._released(folder))
                continue
            left_ms = max(1, round(ms(deadline_s - time.monotonic())))
            event, added = self._link.next_event(1 if images else min(200, left_ms))
            announced += added
            if event == gp.GP_EVENT_TIMEOUT and (images or time.monotonic() >= deadline_s):
                return tuple(images)

    def _released(self, folder: Path) -> CapturedImage:
        """Collect and download the exposure whose file was announced first."""
        announced_s = time.monotonic()
        announced = self._dials.announced
        quality, focus = self._dials.quality(), self._dials.focus()
        expected = 2 if quality == "RAW+JPEG" else 1
        first = announced[:expected]
        del announced[:expected]
        added = self._collect(expected, announced_s, *first)
        return self._image(added, folder, announced_s, quality, focus)

    def _image(
        self, added: list[AddedFile], folder: Path, trigger_s: float, quality: str, focus: str
    ) -> CapturedImage:
        """Download the files of one exposure and check that they are new."""
        arrival_s = time.monotonic()
        self._check_place(added)
        stems = {_parse(one.name)[0] for one in added}
        if len(stems) != 1:
            raise self._stale(f"Files of different exposures arrived together: {', '.join(sorted(stems))}")
        files = sorted((self._save(one, folder) for one in added), key=lambda file: file.media_type != "image/jpeg")
        exif = read_exif(files[0].path)
        if not exif.make.upper().startswith(self._profile.exif_make.upper()):
            raise self._stale(f"{files[0].camera_name} says that it was taken by {exif.make or 'an unknown'} camera")
        image = exif.exposure_of(
            tuple(files),
            _parse(added[0].name)[1],
            exif.settings(focus_mode=focus, image_quality=quality),
            trigger_monotonic_s=trigger_s,
            arrival_monotonic_s=arrival_s,
        )
        self._check_new(image)
        self._clock_offset_s = _clock_offset_s(exif.taken, trigger_s)
        self._last = image
        self._hashes.update(file.sha256 for file in files)
        return image

    def _check_place(self, added: list[AddedFile]) -> None:
        """Files without a folder come from a memory in which libgphoto2 numbers them itself."""
        if "computer" not in self._profile.targets and any(one.folder == "/" for one in added):
            raise DeviceRefusedError(
                f"{added[0].name} came from the camera's memory and not from its card",
                where=self._link.where,
                remedy="Insert a card, and open the camera again",
            )

    def _collect(self, expected: int, trigger_s: float, *first: AddedFile) -> list[AddedFile]:
        added = list(first)
        while len(added) < expected:
            if time.monotonic() - trigger_s > self._config.capture_timeout_s:
                names = ", ".join(one.name for one in added) or "none"
                waited_s = self._config.capture_timeout_s
                raise DeviceTimeoutError(
                    f"expected {expected} file(s) within {waited_s:g} s of the release, received: {names}",
                    where=self._link.where,
                    remedy="Check the save destination and the display of the camera, then take the exposure again"
                    + (f". {self._profile.files_missing}" if self._profile.files_missing else ""),
                )
            added += self._link.next_event(200)[1]
        return added

    def _save(self, added: AddedFile, folder: Path) -> CapturedFile:
        stem, _, suffix = _parse(added.name)
        target = folder / f"{stem}{suffix}"
        if target.exists():
            raise self._stale(f"{target.name} was already downloaded")
        partial = target.with_name(target.name + ".part")
        file = self._link.call(
            f"Fetching {target.name}", lambda c: c.file_get(added.folder, added.name, gp.GP_FILE_TYPE_NORMAL)
        )
        partial.write_bytes(memoryview(file.get_data_and_size()))
        info = self._link.call("Asking the file's size", lambda c: c.file_get_info(added.folder, added.name)).file
        size = partial.stat().st_size
        if info.fields & gp.GP_FILE_INFO_SIZE and info.size != size:
            raise UnreadableFileError(
                f"{target.name} has {size} bytes where the camera announced {info.size}",
                where=str(partial),
                remedy="Take this exposure again; the files recorded before it are not affected",
            )
        if MEDIA_TYPES.get(suffix.upper()) == "image/jpeg":
            check_jpeg_complete(partial)
        partial.rename(target)
        media_type = MEDIA_TYPES.get(suffix.upper(), "application/octet-stream")
        return CapturedFile(target, target.name, sha256_of(target), size, media_type)

    def _check_new(self, image: CapturedImage) -> None:
        last = self._last
        name = image.files[0].camera_name
        if any(file.sha256 in self._hashes for file in image.files):
            raise self._stale(f"{name} is byte for byte the same as an earlier file")
        if last is None:
            return
        if image.counter == last.counter:
            raise self._stale(f"The file counter stayed at {name}")
        if image.counter < last.counter and (image.counter - last.counter) % 10000 > 100:  # 0001 follows 9999
            raise self._stale(f"The file counter went back from {last.files[0].camera_name} to {name}")
        if image.exif_time <= last.exif_time:
            raise self._stale(f"The EXIF time of {name} ({image.exif_time}) is not after {last.exif_time}")

    def _stale(self, what: str) -> StaleImageError:
        return StaleImageError(what, where=self._link.where, remedy="Open the camera again and repeat the exposure")

    # --- live view -----------------------------------------------------------------------------------------

    def preview(self) -> bytes:
        """Return one live-view frame as JPEG bytes; retries for some seconds while the camera is busy."""
        deadline = time.monotonic() + PREVIEW_PATIENCE_S
        while True:
            try:
                frame = self._link.call("Fetching a live-view frame", lambda camera: camera.capture_preview())
                # The frame owns the memory: the variable keeps it alive until the bytes are copied.
                return bytes(memoryview(frame.get_data_and_size()))
            except DeviceBusyError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.3)


def _parse(name: str) -> tuple[str, int, str]:
    """Stem, counter and suffix of a camera's file name; libgphoto2 prefixes files from its memory with capt_."""
    match = _NAME.match(name)
    if match is None:
        raise StaleImageError(f"the file name {name} has no counter", where="camera", remedy="Repeat the exposure")
    return match["stem"], int(match["counter"]), match["suffix"]


def _clock_offset_s(taken: str, trigger_monotonic_s: float) -> float | None:
    """Camera clock minus host UTC when the shutter was released; None if the EXIF time lacks its UTC offset."""
    try:
        stamp = datetime.strptime(taken, "%Y:%m:%d %H:%M:%S.%f%z")
    except ValueError:
        return None
    released = time.time() - (time.monotonic() - trigger_monotonic_s)
    return (stamp - datetime.fromtimestamp(released, UTC)).total_seconds()
