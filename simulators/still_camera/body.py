"""What every simulated camera does: exposures that take real time, planned faults of pictures, files, the card."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import cv2

from simulators.faults import Fault, FaultPlan
from simulators.rendering.picture_faults import Lens
from simulators.rendering.sensor import camera_picture, picture_without_filters, read_out
from simulators.serve import SimulatorError
from simulators.still_camera.exif import ExposureSettings, Nameplate, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw
from simulators.still_camera.scene import ImageSource, Moment

FORMAT_JPEG = 0x3801
HANDLING_S = 0.2  # shutter lag, read-out and processing of a real camera
CARD_BYTES = 128_000_000_000
LEAST_FREE_BYTES = 200_000_000  # below, a camera that saves to its card does not release
TRANSFER_PAUSE_S = 0.3
_LOG = logging.getLogger(__name__)


class BusyError(Exception):
    """The camera is still exposing."""


class CardFullError(Exception):
    """The card has no space for another picture."""


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A finished file in the camera's memory."""

    name: str
    format: int
    data: bytes
    width: int
    height: int
    captured: str


@dataclass(frozen=True, slots=True)
class BodyOptions:
    """Options of the simulated camera's behaviour."""

    fast: bool = False  # neither exposure time nor handling time
    first_counter: int = 1
    exposures_log: Path | None = None
    announce: str = "both"  # event, property or both: how the client learns of a new file
    mosaic_jpeg: bool = False  # beside a raw file: whether the JPEG is made of the same values, as a camera's is
    send_to: Path | None = None  # wireless transfer: files are written into this folder instead of being downloaded
    clock_ahead_s: float = 0.0  # of this machine's


@dataclass(frozen=True, slots=True)
class FileNames:
    """How a camera names and labels its files."""

    stem: str  # format of the counter, such as DSC{:05d}
    raw_suffix: str
    raw_format: int  # PTP object format


class CameraBody(ABC):
    """The camera's state, which outlives connections. A maker's body adds its settings and how files are fetched."""

    def __init__(
        self, source: ImageSource, faults: FaultPlan, options: BodyOptions, plate: Nameplate, names: FileNames
    ) -> None:
        self.options = options
        self.free_bytes = CARD_BYTES * 3 // 4
        self.source = source
        self._faults = faults
        self._plate, self._names = plate, names
        self._lens = Lens()
        self._counter = options.first_counter
        self._previous: list[CameraFile] = []
        self._exposing = threading.Event()
        self._log_lock = threading.Lock()

    @property
    def exposing(self) -> bool:
        """Return whether an exposure is in progress."""
        return self._exposing.is_set()

    @abstractmethod
    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""

    @abstractmethod
    def dial_iso(self, iso: int) -> None:
        """Turn the ISO dial by hand; 0 is what a protocol asks for."""

    @abstractmethod
    def keep(self, files: list[CameraFile], settings: ExposureSettings) -> None:
        """Put finished files where the client fetches them, and announce them."""

    def begun(self) -> None:  # noqa: B027 - most cameras do not announce it
        """Return what the camera says when an exposure begins."""

    def done(self) -> None:  # noqa: B027 - most cameras do not announce it
        """Return what the camera says when an exposure has ended, with or without a file."""

    def press(self, iso: int = 0) -> None:
        """Press the camera's own button, perhaps after the ISO dial was turned; ignored while busy or full."""
        if iso or self.options.send_to is not None:
            self.dial_iso(iso)  # without a cable, a mistake is corrected before the next exposure
        try:
            self.shoot()
        except (BusyError, CardFullError):
            _LOG.warning("the button was pressed while the body was busy or full")

    def shoot(self) -> threading.Thread:
        """Begin an exposure, and return the thread that makes it. Raises BusyError or CardFullError."""
        settings = self.exposure_settings()
        if self._exposing.is_set():
            raise BusyError
        if self.free_bytes <= 0 or (settings.on_card and self.free_bytes < LEAST_FREE_BYTES):
            raise CardFullError
        self._exposing.set()
        fault = self._faults.check("camera", "image")
        counter = self._counter
        self._counter += 1
        self.begun()
        exposing = threading.Thread(
            target=self._expose, args=(counter, settings, fault), name="exposure", daemon=True
        )
        exposing.start()
        return exposing

    def _expose(self, counter: int, settings: ExposureSettings, fault: Fault | None) -> None:
        started = time.monotonic()
        try:
            moment = self.source.freeze(counter)
            taken = datetime.now().astimezone() + timedelta(seconds=self.options.clock_ahead_s)
            files = self._develop(moment, settings, Shot(settings, counter, taken, self._plate), fault)
            if not self.options.fast:
                time.sleep(max(0.0, settings.exposure_s + HANDLING_S - (time.monotonic() - started)))
            self._finish(files, fault, moment, settings, taken)
        except SimulatorError:
            # A camera whose processor fails delivers nothing; the client must notice by itself.
            _LOG.exception("exposure %d gave no picture", counter)
        finally:
            self._exposing.clear()
            self.done()

    def _develop(
        self, moment: Moment, settings: ExposureSettings, shot: Shot, fault: Fault | None
    ) -> list[CameraFile]:
        mosaic = None
        if not settings.raw:
            picture = self._lens.picture(self.source.develop(moment, settings), fault, moment.view)
        else:
            light = self._lens.picture(self.source.light(moment, settings), fault, moment.view)
            mosaic = read_out(light, settings.iso, moment.counter)
            if self.options.mosaic_jpeg:
                picture = camera_picture(mosaic)
            else:
                picture = picture_without_filters(light, settings.iso, moment.counter)
        if fault is not None and fault.kind == "wrong_exif":  # somebody turned a dial at the last moment
            shot = replace(shot, settings=replace(settings, iso=2 * settings.iso))
        captured = f"{shot.taken:%Y%m%dT%H%M%S}"
        height, width = picture.shape[:2]
        stem = self._names.stem.format((moment.counter - 1) % 9999 + 1)
        files: list[CameraFile] = []
        if settings.jpeg and not (fault is not None and fault.kind == "raw_only"):
            jpeg = encode_jpeg(picture, shot)
            files.append(CameraFile(f"{stem}.JPG", FORMAT_JPEG, jpeg, width, height, captured))
        if mosaic is not None:
            name = stem + self._names.raw_suffix
            files.append(CameraFile(name, self._names.raw_format, encode_raw(mosaic, shot), width, height, captured))
        return files

    def _finish(
        self,
        files: list[CameraFile],
        fault: Fault | None,
        moment: Moment,
        settings: ExposureSettings,
        taken: datetime,
    ) -> None:
        kind = fault.kind if fault else ""
        if kind == "no_image":
            return
        if kind == "stale" and self._previous:
            files = self._previous
        elif kind in ("truncate", "corrupt"):
            files = [_damaged(file, kind) for file in files]
        self._previous = files
        if settings.on_card:
            self.free_bytes = max(0, self.free_bytes - sum(len(file.data) for file in files))
        self._write_log(files, moment, settings, taken)
        if self.options.send_to is not None:
            send(files, self.options.send_to)
            return
        self.keep(files, settings)

    def _write_log(
        self, files: list[CameraFile], moment: Moment, settings: ExposureSettings, taken: datetime
    ) -> None:
        if self.options.exposures_log is None or not files:
            return
        first = files[0]
        line = {
            "counter": moment.counter,
            "name": first.name,
            "sha256": hashlib.sha256(first.data).hexdigest(),
            "size": len(first.data),
            "T_world_camera": moment.T_world_camera,
            "settings": {"aperture_f": settings.aperture_f, "exposure_s": settings.exposure_s, "iso": settings.iso},
            "time": taken.isoformat(),
        }
        with self._log_lock, self.options.exposures_log.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")

    def preview_jpeg(self) -> bytes:
        """A live-view frame as JPEG."""
        picture = cv2.cvtColor(self.source.preview(), cv2.COLOR_RGB2BGR)
        done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        if not done:
            raise SimulatorError("the live-view frame could not be encoded")
        return encoded.tobytes()


def send(files: Sequence[CameraFile], folder: Path) -> None:
    """Write files as a camera's wireless transfer does: under their final names, piece by piece."""
    for file in files:
        with (folder / file.name).open("wb") as stream:
            half = len(file.data) // 2
            stream.write(file.data[:half])
            stream.flush()
            time.sleep(TRANSFER_PAUSE_S)
            stream.write(file.data[half:])


def _damaged(file: CameraFile, kind: str) -> CameraFile:
    if kind == "truncate":
        data = file.data[: len(file.data) * 6 // 10]
    else:
        middle = len(file.data) // 2
        data = (
            file.data[:middle] + bytes(b ^ 0x5A for b in file.data[middle : middle + 64]) + file.data[middle + 64 :]
        )
    return CameraFile(file.name, file.format, data, file.width, file.height, file.captured)
