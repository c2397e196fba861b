"""The Canon body: its buttons, the files on its card, and those that wait in its memory."""

from __future__ import annotations

import threading

from simulators.canon_camera import events
from simulators.canon_camera.properties import (
    APERTURE_PRIORITY,
    ISO,
    MEMORY,
    ONE_SHOT,
    Code,
    Properties,
    eos_r5,
)
from simulators.canon_camera.recorded import Table
from simulators.faults import FaultPlan
from simulators.still_camera.body import BodyOptions, CameraBody, CameraFile, FileNames
from simulators.still_camera.card import FOLDER_PICTURES, STORAGE
from simulators.still_camera.exif import ExposureSettings, Nameplate
from simulators.still_camera.scene import ImageSource

FORMAT_CR3 = 0xB108
PICTURE_BYTES = 30_000_000  # by which the remaining pictures are counted
_IN_MEMORY = 0x40000000
_PROTOCOL_ISO = 100
_STEP_WIDTHS = {1: 1, 2: 8, 3: 64}  # of our own choice: how far a lens goes differs
DIALLED = {Code.APERTURE: 0x50, Code.SHUTTER: 0x58, Code.ISO: 0x48}


class CanonBody(CameraBody):
    """An EOS R5 or a body that was recorded, whose files stay on its card."""

    def __init__(
        self, source: ImageSource, faults: FaultPlan, options: BodyOptions, recorded: Table | None = None
    ) -> None:
        self.table = table = recorded or eos_r5()
        version = f"Firmware Version {table.firmware.rpartition('-')[2]}"
        plate = Nameplate("Canon", table.model, table.lens, table.serial, version, sub_second_digits=2)
        super().__init__(source, faults, options, plate, FileNames("IMG_{:04d}", ".CR3", FORMAT_CR3))
        self.properties = Properties(table)
        if table.free_bytes is not None:
            self.free_bytes = table.free_bytes
        if recorded is None:
            self.count_shots()
        self.has_card = True
        self.focus_steps = 0  # by which the lens was driven; away from the camera counts up
        self._files: dict[int, CameraFile] = {}
        self._lock = threading.Lock()
        if options.send_to is not None:
            # Nobody can set this camera remotely: a technician has dialled in what a protocol asks for.
            for code, value in DIALLED.items():
                self.properties.put(code, value)

    def set_by_hand(self, *, autofocus: bool, aperture_priority: bool) -> None:
        """Turn the switch on the lens, and the mode dial."""
        if autofocus:
            self.properties.put(Code.FOCUS, ONE_SHOT)
        if aperture_priority:
            self.properties.put(Code.EXPOSURE_MODE, APERTURE_PRIORITY)

    def drive_lens(self, amount: int) -> None:
        """Move the focus by 1, 2 or 3 widths of step towards the camera, or away from it (from 8001 on)."""
        width = _STEP_WIDTHS[amount & 0x7FFF]
        self.focus_steps += width if amount & 0x8000 else -width

    def take_card_out(self) -> None:
        """From now on, files go to the memory only."""
        self.has_card = False
        self.properties.offer(Code.DESTINATION, (MEMORY,))

    def count_shots(self) -> None:
        """Say how many pictures the card still holds."""
        self.properties.put(Code.AVAILABLE_SHOTS, self.free_bytes // PICTURE_BYTES)

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        return self.properties.exposure_settings()

    def dial_iso(self, iso: int) -> None:
        """Turn the ISO dial by hand."""
        wanted = iso or _PROTOCOL_ISO
        self.properties.put(Code.ISO, next(code for code, known in ISO.items() if known == wanted))

    def begun(self) -> None:
        """Say that an exposure has begun."""
        self.properties.announce(events.status(busy=True))

    def done(self) -> None:
        """Say that the exposure has ended."""
        self.properties.announce(events.status(busy=False))

    def keep(self, files: list[CameraFile], settings: ExposureSettings) -> None:
        """Put finished files on the card, or into the memory, and announce them."""
        with self._lock:
            for file in files:
                base = FOLDER_PICTURES if settings.on_card else _IN_MEMORY
                handle = base + 1 + len(self._files)
                self._files[handle] = file
                if settings.on_card:
                    self.properties.announce(events.object_added(handle, STORAGE, FOLDER_PICTURES, file))
                else:
                    self.properties.announce(events.transfer_wanted(handle, file))
        self.count_shots()

    def file(self, handle: int) -> CameraFile | None:
        """A file on the card or in the memory."""
        with self._lock:
            return self._files.get(handle)

    def on_card(self) -> tuple[int, ...]:
        """The handles of the files on the card."""
        with self._lock:
            return tuple(handle for handle in self._files if handle < _IN_MEMORY)

    def fetched(self, handle: int) -> None:
        """Drop a file from the memory, once the client has it."""
        with self._lock:
            if handle >= _IN_MEMORY:
                self._files.pop(handle, None)
