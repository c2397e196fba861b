"""The properties of a Sony body: how they are encoded, which can be set, and how some follow others."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from simulators.ptpip import codec
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.operations import NotWritableError, RefusedValueError

_FORMATS = {1: "<b", 2: "<B", 3: "<h", 4: "<H", 5: "<i", 6: "<I", 7: "<q", 8: "<Q"}
I8, U8, I16, U16, U32 = 1, 2, 3, 4, 6
TEXT = 0xFFFF


class Code(IntEnum):
    """Property codes that the camera itself uses; those from D2C1 on are controls, which cannot be read."""

    COMPRESSION = 0x5004
    WHITE_BALANCE = 0x5005
    F_NUMBER = 0x5007
    FOCUS_MODE = 0x500A
    EXPOSURE_PROGRAM = 0x500E
    EXPOSURE_COMPENSATION = 0x5010
    DRIVE_MODE = 0x5013
    LENS_NAME = 0xD07B
    STABILIZATION = 0xD0D9
    SILENT_MODE = 0xD0DB
    SHUTTER_TYPE = 0xD0DF
    NAME_PREFIX = 0xD1CA
    IMAGE_SIZE = 0xD203
    SHUTTER_SPEED = 0xD20D
    ASPECT_RATIO = 0xD211
    FOCUS_STATUS = 0xD213
    OBJECTS_IN_MEMORY = 0xD215
    BATTERY = 0xD218
    SENSOR_CROP = 0xD219
    ISO = 0xD21E
    CAPTURE_TARGET = 0xD222
    FOCUS_CAN_BE_DRIVEN = 0xD235
    SLOT_1_STATE = 0xD248
    SLOT_1_SHOTS = 0xD249
    FOCAL_POSITION = 0xD24C
    JPEG_QUALITY = 0xD252
    FILE_FORMAT = 0xD253
    SLOT_2_STATE = 0xD256
    SLOT_2_SHOTS = 0xD257
    PRIORITY_MODE = 0xD25A
    COMPUTER_IMAGE_SIZE = 0xD268
    COMPUTER_FILES = 0xD269
    HALF_PRESS = 0xD2C1
    FULL_PRESS = 0xD2C2
    FOCUS_STEP = 0xD2D1
    FOCUS_REST = 0xD2D2  # libgphoto2 sends this for a step of zero


CONTROLS = (Code.HALF_PRESS, Code.FULL_PRESS, Code.FOCUS_STEP, Code.FOCUS_REST)
MANUAL_FOCUS, DIRECT_MANUAL_FOCUS = 1, 0x8006
FILE_RAW, FILE_RAW_JPEG, FILE_JPEG = 1, 2, 3
TARGET_COMPUTER, TARGET_CARD, TARGET_BOTH = 1, 16, 17
CARD, NO_CARD = 1, 2
NO_F_NUMBER = 0xFFFE  # without a lens, or with one that has no contacts
_COMPRESSIONS_RAW, _COMPRESSIONS_BOTH = (16,), (17, 18, 19, 20)  # of protocol 2.00


class Enabled(IntEnum):
    """The sixth byte of an entry: whether the property can be set."""

    GREY = 0
    ON = 1
    DISPLAY_ONLY = 2


@dataclass(slots=True)
class CameraProperty:
    """One entry of the table.

    `choices` is None without a form, and may be empty; `limits` is (minimum, maximum, step).
    """

    code: int
    datatype: int
    value: int | str
    choices: tuple[int, ...] | None = None
    limits: tuple[int, int, int] | None = None
    enabled: Enabled = Enabled.ON
    get_set: bool | None = None  # the fifth byte, where it does not follow from the sixth
    late_s: float = 0.0  # how long it takes until a value that was set is stated
    coming: tuple[float, int | str] | None = None  # a value, and the time.monotonic() from which it is stated

    def pack(self, value: int | str) -> bytes:
        """Encode a value in the property's type."""
        return codec.string(value) if isinstance(value, str) else struct.pack(_FORMATS[self.datatype], value)

    def unpack(self, data: bytes) -> int | str:
        """Decode a value from the client, which sends 4 bytes for some 2-byte types; only the first ones count."""
        if self.datatype == TEXT:
            return data[1:].decode("utf-16-le", errors="replace").rstrip("\0")
        layout = _FORMATS[self.datatype]
        if len(data) < struct.calcsize(layout):
            raise RefusedValueError(f"{self.code:04X}: {len(data)} bytes are not a valid value")
        return int(struct.unpack_from(layout, data)[0])

    def encode(self, *, twice: bool) -> bytes:
        """Encode the entry: code, type, get/set, enabled, default, current, form.

        In protocol 3.00 an enumeration is written `twice`: what can be set now, and what exists.
        """
        settable = self.enabled is Enabled.ON if self.get_set is None else self.get_set
        head = struct.pack("<HHBB", self.code, self.datatype, settable, self.enabled)
        head += self.pack("" if self.datatype == TEXT else 0) + self.pack(self.value)
        if self.limits is not None:
            return head + b"\x01" + b"".join(self.pack(number) for number in self.limits)
        if self.choices is None:
            return head + b"\x00"
        listing = struct.pack("<H", len(self.choices)) + b"".join(self.pack(choice) for choice in self.choices)
        return head + b"\x02" + listing * (2 if twice else 1)

    def accept(self, value: int | str) -> None:
        """Set a value if the camera offers it. Raises NotWritableError or RefusedValueError."""
        if self.enabled is not Enabled.ON:
            raise NotWritableError(f"{self.code:04X}")
        if self.choices and value not in self.choices:
            raise RefusedValueError(f"{self.code:04X} does not offer {value}")
        if self.limits is not None and not self.limits[0] <= int(value) <= self.limits[1]:
            raise RefusedValueError(f"{self.code:04X} {value} is out of range")
        if self.late_s:
            self.coming = time.monotonic() + self.late_s, value
        else:
            self.value = value

    def settle(self) -> None:
        """State a value that was set long enough ago."""
        if self.coming is not None and time.monotonic() >= self.coming[0]:
            self.value, self.coming = self.coming[1], None


@dataclass(frozen=True, slots=True)
class BodyTable:
    """Holds what a body states about itself after power-on."""

    model: str
    firmware: str
    protocol: int  # 200 or 300
    properties: tuple[CameraProperty, ...]
    controls: tuple[int, ...] = CONTROLS
    lens: str = "FE 24-70mm F2.8 GM"


class PropertyTable:
    """All properties behind one lock; used by the command thread and the exposure thread."""

    def __init__(self, table: BodyTable) -> None:
        self._protocol, self._controls = table.protocol, table.controls
        self._entries = {entry.code: entry for entry in table.properties}
        self._lock = threading.Lock()

    def codes(self) -> tuple[int, ...]:
        """The property codes in the table's order."""
        return tuple(self._entries)

    def encode_all(self) -> bytes:
        """Encode the answer to 9209: 8-byte count, then all entries."""
        with self._lock:
            for entry in self._entries.values():
                entry.settle()
            entries = [entry.encode(twice=self._protocol >= 300) for entry in self._entries.values()]
        return struct.pack("<Q", len(entries)) + b"".join(entries)

    def extension_info(self) -> bytes:
        """Encode the answer to 9202: version, codes of the properties, codes of the controls."""
        codes = self.codes()
        listing = struct.pack(f"<HI{len(codes)}H", self._protocol, len(codes), *codes)
        return listing + struct.pack(f"<I{len(self._controls)}H", len(self._controls), *self._controls)

    def set_from_client(self, code: int, data: bytes) -> None:
        """Set a value as operation 9205 does. Raises NotWritableError or RefusedValueError."""
        with self._lock:
            entry = self._entries.get(code)
            if entry is None:
                raise NotWritableError(f"{code:04X}")
            entry.accept(entry.unpack(data))
            if code == Code.FILE_FORMAT:
                self._follow_file_format(raw_only=entry.value == FILE_RAW)

    def _follow_file_format(self, *, raw_only: bool) -> None:
        """While only RAW is set, nothing about a JPEG can be, and its quality is none."""
        for code in (Code.JPEG_QUALITY, Code.IMAGE_SIZE):
            if entry := self._entries.get(code):
                entry.enabled, entry.get_set = Enabled.DISPLAY_ONLY if raw_only else Enabled.ON, None
        if entry := self._entries.get(Code.JPEG_QUALITY):
            entry.value = 0 if raw_only else entry.value or _STANDARD_QUALITY

    def step(self, code: int, steps: int, ladder: Sequence[int]) -> None:
        """Go so many steps along a ladder of values, as bodies of protocol 2.00 are set."""
        with self._lock:
            entry = self._entries.get(code)
            if entry is None or not isinstance(entry.value, int):
                raise NotWritableError(f"{code:04X}")
            allowed = [
                one
                for one in ladder
                if entry.limits is None or code != Code.F_NUMBER or entry.limits[0] <= one <= entry.limits[1]
            ]
            if not allowed:
                raise NotWritableError(f"{code:04X}")
            nearest = min(range(len(allowed)), key=lambda i: abs(allowed[i] - int(entry.value)))
            entry.value = allowed[min(len(allowed) - 1, max(0, nearest + steps))]

    def put(self, code: int, value: int) -> None:
        """Change a value from inside the camera (focus status, objects in memory, battery), if it has it."""
        with self._lock:
            entry = self._entries.get(code)
            if entry is not None and entry.datatype != TEXT:
                entry.value = value

    def fix(self, code: int, value: int, choices: tuple[int, ...] | None = None) -> None:
        """Keep a property at this value, with these choices if they change: a switch of the lens, or no lens."""
        with self._lock:
            if entry := self._entries.get(code):
                entry.value, entry.enabled, entry.get_set = value, Enabled.GREY, None
                entry.choices = entry.choices if choices is None else choices

    def value(self, code: int, otherwise: int = 0) -> int:
        """The current raw number; `otherwise` if the body does not have the property."""
        with self._lock:
            entry = self._entries.get(code)
            return entry.value if entry is not None and isinstance(entry.value, int) else otherwise

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        shutter = self.value(Code.SHUTTER_SPEED) or _BULB
        numerator, denominator = shutter >> 16, shutter & 0xFFFF
        f_number = self.value(Code.F_NUMBER)
        has_lens = 0 < f_number < NO_F_NUMBER
        iso = self.value(Code.ISO) & 0xFFFFFF
        jpeg, raw = self._files()
        level = self.value(Code.JPEG_QUALITY)
        return ExposureSettings(
            aperture_f=f_number / 100.0 if has_lens else 8.0,
            exposure_s=numerator / denominator,
            exposure_fraction=(numerator, denominator),
            iso=min(iso, _MOST_IN_EXIF) if 0 < iso < 0xFFFFFF else _AUTO_ISO,
            jpeg=jpeg,
            raw=raw,
            jpeg_level=level if level in _LEVELS else _STANDARD_QUALITY,
            on_card=self.value(Code.CAPTURE_TARGET, TARGET_COMPUTER) != TARGET_COMPUTER,
            states_aperture=has_lens,
        )

    def _files(self) -> tuple[bool, bool]:
        """Return whether an exposure gives a JPEG, and whether a raw file."""
        if kind := self.value(Code.FILE_FORMAT):
            return kind != FILE_RAW, kind != FILE_JPEG
        compression = self.value(Code.COMPRESSION)
        raw = compression in (*_COMPRESSIONS_RAW, *_COMPRESSIONS_BOTH)
        return compression not in _COMPRESSIONS_RAW, raw


_STANDARD_QUALITY, _LEVELS = 2, range(1, 5)
_BULB = 1 << 16 | 2  # somebody holds the button for half a second
_AUTO_ISO, _MOST_IN_EXIF = 400, 65535


def shutter_code(numerator: int, denominator: int) -> int:
    """Encode an exposure time as the camera does: numerator in the high word, denominator in the low word."""
    return numerator << 16 | denominator
