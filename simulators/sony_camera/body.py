"""The camera behind the wire: buttons, exposures that take real time, files waiting for download, and the card."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import cv2

from simulators.faults import Fault, FaultPlan
from simulators.rendering.picture_faults import Lens
from simulators.rendering.sensor import camera_picture, picture_without_filters, read_out
from simulators.serve import SimulatorError
from simulators.sony_camera.exif import Shot, encode_jpeg
from simulators.sony_camera.properties import (
    FILE_JPEG,
    FILE_RAW,
    MANUAL_FOCUS,
    TARGET_COMPUTER,
    Code,
    ExposureSettings,
    NotWritableError,
    PropertyTable,
    shutter_code,
)
from simulators.sony_camera.raw_file import encode_raw
from simulators.sony_camera.scene import ImageSource, Moment

FORMAT_JPEG, FORMAT_ARW = 0x3801, 0xB101
HANDLING_S = 0.2  # shutter lag, read-out and processing of a real camera
CARD_BYTES = 128_000_000_000
FOCUSED, NOT_FOCUSED = 2, 1
TRANSFER_PAUSE_S = 0.3
DIALLED = {
    Code.F_NUMBER: 2200,
    Code.SHUTTER_SPEED: shutter_code(1, 15),
    Code.ISO: 100,
    Code.FOCUS_MODE: MANUAL_FOCUS,
}
_PRESSED = 2
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


class CameraBody:
    """The camera's state, which outlives connections. `on_object` is called once for each file that becomes ready."""

    def __init__(self, source: ImageSource, faults: FaultPlan, options: BodyOptions) -> None:
        self.properties = PropertyTable()
        self.options = options
        self.on_object: Callable[[], None] = lambda: None
        self.free_bytes = CARD_BYTES * 3 // 4
        self._source = source
        self._faults = faults
        self._lens = Lens()
        self._counter = options.first_counter
        self._waiting: deque[CameraFile] = deque()
        self._previous: list[CameraFile] = []
        self._lock = threading.Lock()
        self._half_pressed = False
        self._exposing = threading.Event()
        self._log_lock = threading.Lock()
        if options.send_to is not None:
            # Nobody can set this camera remotely: a technician has dialled in what a protocol asks for.
            for code, value in DIALLED.items():
                self.properties.put(code, value)

    @property
    def exposing(self) -> bool:
        """Whether an exposure is in progress."""
        return self._exposing.is_set()

    def button(self, code: int, state: int) -> None:
        """Handle a half or full press (2), a release (1), or a focus step given as a signed 16-bit number.

        Raises BusyError or CardFullError for a full press, NotWritableError for a focus step in autofocus.
        """
        if code == Code.HALF_PRESS:
            self._half_pressed = state == _PRESSED
            self.properties.put(Code.FOCUS_STATUS, FOCUSED if self._half_pressed else NOT_FOCUSED)
        elif code == Code.FULL_PRESS and state == _PRESSED:
            self._shoot()
        elif code == Code.FOCUS_STEP:
            self._step_focus(state - 0x10000 if state & 0x8000 else state)

    def _step_focus(self, steps: int) -> None:
        if self.properties.value(Code.FOCUS_MODE) != MANUAL_FOCUS:
            raise NotWritableError("the focus can only be moved in manual focus")
        position = self.properties.value(Code.FOCAL_POSITION) + steps
        self.properties.put(Code.FOCAL_POSITION, min(100, max(0, position)))

    def press(self, iso: int = 0) -> None:
        """Press the camera's own button, perhaps after the ISO dial was turned; ignored while busy or full."""
        if self.options.send_to is not None:
            self.properties.put(Code.ISO, iso or DIALLED[Code.ISO])  # a mistake is corrected before the next exposure
        elif iso:
            self.properties.put(Code.ISO, iso)
        try:
            self._shoot()
        except (BusyError, CardFullError):
            _LOG.warning("the button was pressed while the body was busy or full")

    def _shoot(self) -> None:
        settings = self.properties.exposure_settings()
        if self._exposing.is_set():
            raise BusyError
        if self.free_bytes <= 0 or (settings.capture_target != TARGET_COMPUTER and self.free_bytes < 200_000_000):
            raise CardFullError
        self._exposing.set()
        fault = self._faults.check("camera", "image")
        counter = self._counter
        self._counter += 1
        threading.Thread(target=self._expose, args=(counter, settings, fault), name="exposure", daemon=True).start()

    def _expose(self, counter: int, settings: ExposureSettings, fault: Fault | None) -> None:
        started = time.monotonic()
        try:
            moment = self._source.freeze(counter)
            taken = datetime.now().astimezone()
            files = self._develop(moment, settings, Shot(settings, counter, taken), fault)
            if not self.options.fast:
                time.sleep(max(0.0, settings.exposure_s + HANDLING_S - (time.monotonic() - started)))
            self._finish(files, fault, moment, settings, taken)
        except SimulatorError:
            # A camera whose processor fails delivers nothing; the client must notice by itself.
            _LOG.exception("exposure %d gave no picture", counter)
        finally:
            self._exposing.clear()

    def _develop(
        self, moment: Moment, settings: ExposureSettings, shot: Shot, fault: Fault | None
    ) -> list[CameraFile]:
        mosaic = None
        if settings.file_format == FILE_JPEG:
            picture = self._lens.picture(self._source.develop(moment, settings), fault, moment.view)
        else:
            light = self._lens.picture(self._source.light(moment, settings), fault, moment.view)
            mosaic = read_out(light, settings.iso, moment.counter)
            if self.options.mosaic_jpeg:
                picture = camera_picture(mosaic)
            else:
                picture = picture_without_filters(light, settings.iso, moment.counter)
        if fault is not None and fault.kind == "wrong_exif":  # somebody turned a dial at the last moment
            shot = replace(shot, settings=replace(settings, iso=2 * settings.iso))
        captured = f"{shot.taken:%Y%m%dT%H%M%S}"
        height, width = picture.shape[:2]
        stem = f"DSC{(moment.counter - 1) % 9999 + 1:05d}"
        files: list[CameraFile] = []
        if settings.file_format != FILE_RAW and not (fault is not None and fault.kind == "raw_only"):
            jpeg = encode_jpeg(picture, shot)
            files.append(CameraFile(f"{stem}.JPG", FORMAT_JPEG, jpeg, width, height, captured))
        if mosaic is not None:
            raw = encode_raw(mosaic, shot)
            files.append(CameraFile(f"{stem}.ARW", FORMAT_ARW, raw, width, height, captured))
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
        if settings.capture_target != TARGET_COMPUTER:
            self.free_bytes = max(0, self.free_bytes - sum(len(file.data) for file in files))
        self._write_log(files, moment, settings, taken)
        if self.options.send_to is not None:
            send(files, self.options.send_to)
            return
        with self._lock:
            self._waiting.extend(files)
            self._count()
        if self.options.announce != "property":
            for _ in files:
                self.on_object()

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

    def _count(self) -> None:
        waiting = len(self._waiting)
        self.properties.put(Code.OBJECTS_IN_MEMORY, 0x8000 + waiting if waiting else 0)

    def next_file(self) -> CameraFile | None:
        """The file that GetObjectInfo on FFFFC001 describes, or None."""
        with self._lock:
            return self._waiting[0] if self._waiting else None

    def pop_file(self) -> CameraFile | None:
        """Remove and return that file."""
        with self._lock:
            file = self._waiting.popleft() if self._waiting else None
            self._count()
            return file

    def live_view(self) -> bytes:
        """A live-view frame: offset and size of the JPEG, padding, JPEG."""
        picture = cv2.cvtColor(self._source.preview(), cv2.COLOR_RGB2BGR)
        done, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        if not done:
            raise SimulatorError("the live-view frame could not be encoded")
        jpeg = encoded.tobytes()
        offset = 136
        head = offset.to_bytes(4, "little") + len(jpeg).to_bytes(4, "little")
        return head.ljust(offset, b"\0") + jpeg


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
