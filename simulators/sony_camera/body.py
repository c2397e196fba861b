"""The Sony body: its buttons, and the files that wait in its memory until they are fetched."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from simulators.faults import FaultPlan
from simulators.sony_camera.alpha_7r_v import F_NUMBERS, ISO, SHUTTERS, alpha_7r_v
from simulators.sony_camera.exif import PLATE
from simulators.sony_camera.properties import (
    CONTROLS,
    DIRECT_MANUAL_FOCUS,
    MANUAL_FOCUS,
    NO_F_NUMBER,
    BodyTable,
    Code,
    PropertyTable,
    shutter_code,
)
from simulators.still_camera.body import BodyOptions, CameraBody, CameraFile, FileNames
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.operations import NotWritableError
from simulators.still_camera.scene import ImageSource

FORMAT_ARW = 0xB101
FOCUSED, NOT_FOCUSED = 2, 1
DIALLED = {
    Code.F_NUMBER: 2200,
    Code.SHUTTER_SPEED: shutter_code(1, 15),
    Code.ISO: 100,
    Code.FOCUS_MODE: MANUAL_FOCUS,
}
_PRESSED = 2
_PICTURE_BYTES = 100_000_000  # by which the remaining photographs are counted
_BEING_WRITTEN = 1  # what D215 states meanwhile; reading the file then crashes a real body
_WRITING_S = 0.05
_DIRECT = 300  # the protocol from which aperture, shutter time and ISO are set and not stepped
_LADDERS = {Code.F_NUMBER: F_NUMBERS, Code.SHUTTER_SPEED: SHUTTERS, Code.ISO: ISO}


@dataclass(frozen=True, slots=True)
class SonyOptions:
    """Holds what is peculiar to a Sony: its lens, its start, and how it tells of a file."""

    lens: str = "AF"  # the switch on the lens, AF or MF; "" without a lens
    not_ready_s: float = 0.0  # after a session was opened, releases give no photograph for so long
    bare_event: bool = False  # C206 without a parameter instead of C201, as some bodies


class SonyBody(CameraBody):
    """A body with this table; an ILCE-7RM5 by itself. `on_object` is called once for each file that becomes ready."""

    def __init__(
        self,
        source: ImageSource,
        faults: FaultPlan,
        options: BodyOptions,
        table: BodyTable | None = None,
        sony: SonyOptions | None = None,
    ) -> None:
        self.table = table or alpha_7r_v()
        self.sony = sony or SonyOptions()
        plate = replace(
            PLATE,
            model=self.table.model,
            lens=self.table.lens if self.sony.lens else "",
            firmware=f"{self.table.model} v{self.table.firmware}",
        )
        super().__init__(source, faults, options, plate, FileNames("DSC{:05d}", ".ARW", FORMAT_ARW))
        self.properties = PropertyTable(self.table)
        self._ready_s = 0.0
        self.on_object: Callable[[], None] = lambda: None
        self._waiting: deque[CameraFile] = deque()
        self._lock = threading.Lock()
        self._half_pressed = False
        if self.sony.lens != "AF":
            self.properties.fix(Code.FOCUS_MODE, MANUAL_FOCUS)
        if not self.sony.lens:
            self.properties.fix(Code.F_NUMBER, NO_F_NUMBER, ())
            self.properties.fix(Code.FOCUS_CAN_BE_DRIVEN, 0)
        if options.send_to is not None:
            # Nobody can set this camera remotely: a technician has dialled in what a protocol asks for.
            for code, value in DIALLED.items():
                self.properties.put(code, value)

    @property
    def controls(self) -> tuple[int, ...]:
        """Return what can be pressed or stepped."""
        return tuple({*self.table.controls, *CONTROLS, *(_LADDERS if self.table.protocol < _DIRECT else ())})

    def session_opened(self) -> None:
        """A client has connected: from now on the body is not ready for a while."""
        self._ready_s = time.monotonic() + self.sony.not_ready_s

    def count_shots(self) -> None:
        """Say how many photographs the card still holds."""
        self.properties.put(Code.SLOT_1_SHOTS, self.free_bytes // _PICTURE_BYTES)

    def fill_card(self) -> None:
        """Leave so much room on the card as the table says."""
        self.free_bytes = self.properties.value(Code.SLOT_1_SHOTS) * _PICTURE_BYTES

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        return self.properties.exposure_settings()

    def dial_iso(self, iso: int) -> None:
        """Turn the ISO dial by hand."""
        self.properties.put(Code.ISO, iso or DIALLED[Code.ISO])

    def button(self, code: int, state: int) -> None:
        """Handle a half or full press (2), a release (1), or a focus step given as a signed 16-bit number.

        Raises BusyError or CardFullError for a full press, NotWritableError for a focus step in autofocus.
        """
        if code == Code.HALF_PRESS:
            self._half_pressed = state == _PRESSED
            self.properties.put(Code.FOCUS_STATUS, FOCUSED if self._half_pressed else NOT_FOCUSED)
        elif code == Code.FULL_PRESS and state == _PRESSED:
            if time.monotonic() >= self._ready_s:
                self.shoot()
        elif code == Code.FOCUS_STEP:
            self._step_focus(state - 0x10000 if state & 0x8000 else state)
        elif code in _LADDERS:
            steps = state & 0xFF
            self.properties.step(code, steps - 0x100 if steps & 0x80 else steps, _LADDERS[Code(code)])

    def _step_focus(self, steps: int) -> None:
        if self.properties.value(Code.FOCUS_MODE) not in (MANUAL_FOCUS, DIRECT_MANUAL_FOCUS):
            raise NotWritableError("the focus can only be moved in manual focus")
        position = self.properties.value(Code.FOCAL_POSITION) + steps
        self.properties.put(Code.FOCAL_POSITION, min(100, max(0, position)))

    def keep(self, files: list[CameraFile], settings: ExposureSettings) -> None:
        """Put finished files into the queue, and announce them."""
        del settings
        self.properties.put(Code.OBJECTS_IN_MEMORY, _BEING_WRITTEN)
        if not self.options.fast:
            time.sleep(_WRITING_S)
        with self._lock:
            self._waiting.extend(files)
            self._count()
        if self.options.announce != "property":
            for _ in files:
                self.on_object()

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
        jpeg, offset = self.preview_jpeg(), 136
        head = offset.to_bytes(4, "little") + len(jpeg).to_bytes(4, "little")
        return head.ljust(offset, b"\0") + jpeg
