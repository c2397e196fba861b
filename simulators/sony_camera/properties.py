"""The property table of an ILCE-7RM5 (protocol 3.00): codes, types, choices and current values."""

from __future__ import annotations

import struct
import threading
from dataclasses import dataclass, field
from enum import IntEnum

from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.operations import NotWritableError, RefusedValueError

PROTOCOL_VERSION = 300
_FORMATS = {1: "<b", 2: "<B", 3: "<h", 4: "<H", 5: "<i", 6: "<I"}


class Code(IntEnum):
    """Property codes; those from D2C1 on are controls, which cannot be read."""

    COMPRESSION = 0x5004
    WHITE_BALANCE = 0x5005
    F_NUMBER = 0x5007
    FOCUS_MODE = 0x500A
    EXPOSURE_PROGRAM = 0x500E
    EXPOSURE_COMPENSATION = 0x5010
    DRIVE_MODE = 0x5013
    IMAGE_SIZE = 0xD203
    SHUTTER_SPEED = 0xD20D
    FOCUS_STATUS = 0xD213
    OBJECTS_IN_MEMORY = 0xD215
    BATTERY = 0xD218
    ISO = 0xD21E
    CAPTURE_TARGET = 0xD222
    FOCUS_CAN_BE_DRIVEN = 0xD235
    FOCAL_POSITION = 0xD24C
    JPEG_QUALITY = 0xD252
    FILE_FORMAT = 0xD253
    PRIORITY_MODE = 0xD25A
    HALF_PRESS = 0xD2C1
    FULL_PRESS = 0xD2C2
    FOCUS_STEP = 0xD2D1
    FOCUS_REST = 0xD2D2  # libgphoto2 sends this for a step of zero


CONTROLS = (Code.HALF_PRESS, Code.FULL_PRESS, Code.FOCUS_STEP, Code.FOCUS_REST)
MANUAL_FOCUS, DIRECT_MANUAL_FOCUS = 1, 0x8006
FILE_RAW, FILE_RAW_JPEG, FILE_JPEG = 1, 2, 3
TARGET_COMPUTER, TARGET_CARD, TARGET_BOTH = 1, 16, 17


class Enabled(IntEnum):
    """The sixth byte of an entry: whether the property can be set."""

    GREY = 0
    ON = 1
    DISPLAY_ONLY = 2


@dataclass(slots=True)
class CameraProperty:
    """One entry of the table; empty `choices` means no form, `limits` is (minimum, maximum, step)."""

    code: Code
    datatype: int
    value: int
    choices: tuple[int, ...] = ()
    limits: tuple[int, int, int] | None = None
    enabled: Enabled = Enabled.ON
    default: int = field(init=False)

    def __post_init__(self) -> None:
        self.default = self.value

    def pack(self, value: int) -> bytes:
        """Encode a value in the property's type."""
        return struct.pack(_FORMATS[self.datatype], value)

    def unpack(self, data: bytes) -> int:
        """Decode a value from the client, which sends 4 bytes for some 2-byte types; only the first ones count."""
        layout = _FORMATS[self.datatype]
        if len(data) < struct.calcsize(layout):
            raise RefusedValueError(f"{self.code.name}: {len(data)} bytes are not a valid value")
        return int(struct.unpack_from(layout, data)[0])

    def encode(self) -> bytes:
        """Encode the entry: code, type, get/set, enabled, default, current, form.

        In protocol 3.00 the list of an enumeration is repeated.
        """
        settable = self.enabled is Enabled.ON
        head = struct.pack("<HHBB", self.code, self.datatype, settable, self.enabled)
        head += self.pack(self.default) + self.pack(self.value)
        if self.limits is not None:
            return head + b"\x01" + b"".join(self.pack(number) for number in self.limits)
        if not self.choices:
            return head + b"\x00"
        listing = struct.pack("<H", len(self.choices)) + b"".join(self.pack(choice) for choice in self.choices)
        return head + b"\x02" + listing + listing

    def accept(self, value: int) -> None:
        """Set a value if the camera offers it. Raises NotWritableError or RefusedValueError."""
        if self.enabled is not Enabled.ON:
            raise NotWritableError(self.code.name)
        if self.choices and value not in self.choices:
            raise RefusedValueError(f"{self.code.name} does not offer {value}")
        if self.limits is not None and not self.limits[0] <= value <= self.limits[1]:
            raise RefusedValueError(f"{self.code.name} {value} is out of range")
        self.value = value


def shutter_code(numerator: int, denominator: int) -> int:
    """Encode an exposure time as the camera does: numerator in the high word, denominator in the low word."""
    return numerator << 16 | denominator


_APERTURES = (280, 320, 350, 400, 450, 500, 560, 630, 710, 800, 900, 1000, 1100, 1300, 1400, 1600, 1800, 2000, 2200)
_TENTHS = (300, 250, 200, 150, 130, 100, 80, 60, 50, 40, 32, 25, 20, 16, 13, 10, 8, 6, 5, 4)
_FRACTIONS = (3, 4, 5, 6, 8, 10, 13, 15, 20, 25, 30, 40, 50, 60, 80, 100, 125, 160, 200, 250, 320, 400, 500, 640, 800)
_FAST = (1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400, 8000)
_SHUTTERS = tuple(shutter_code(tenths, 10) for tenths in _TENTHS) + tuple(
    shutter_code(1, denominator) for denominator in _FRACTIONS + _FAST
)
_ISO = (50, 64, 80, 100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 6400, 12800)
_WHITE_BALANCE = (2, 4, 0x8011, 0x8010, 6, 0x8001, 0x8002, 0x8003, 0x8004, 7, 0x8012, 0x8020, 0x8021, 0x8022)
# Thousandths of a stop, from +5 to -5 by thirds; with the dial on M they change no picture.
_ABOVE_ZERO = (5000, 4700, 4300, 4000, 3700, 3300, 3000, 2700, 2300, 2000, 1700, 1300, 1000, 700, 300)
_COMPENSATIONS = (*_ABOVE_ZERO, 0, *(-number for number in reversed(_ABOVE_ZERO)))
_U8, _I16, _U16, _U32, _I8 = 2, 3, 4, 6, 1


def initial_properties() -> list[CameraProperty]:
    """The table after power-on: dial on M, autofocus, JPEG Fine, files to the computer."""
    return [
        CameraProperty(Code.WHITE_BALANCE, _U16, 4, _WHITE_BALANCE),
        CameraProperty(Code.F_NUMBER, _U16, 800, _APERTURES),
        CameraProperty(Code.FOCUS_MODE, _U16, 2, (2, 0x8005, 0x8004, DIRECT_MANUAL_FOCUS, MANUAL_FOCUS)),
        CameraProperty(Code.EXPOSURE_PROGRAM, _U32, 1, (), enabled=Enabled.DISPLAY_ONLY),
        CameraProperty(Code.EXPOSURE_COMPENSATION, _I16, 0, _COMPENSATIONS),
        CameraProperty(Code.DRIVE_MODE, _U32, 1, (1, 0x8010, 2, 0x8012, 0x8003, 0x8004, 0x8005)),
        CameraProperty(Code.IMAGE_SIZE, _U8, 1, (1, 2, 3)),
        CameraProperty(Code.SHUTTER_SPEED, _U32, shutter_code(1, 60), _SHUTTERS),
        CameraProperty(Code.FOCUS_STATUS, _U8, 1, (), enabled=Enabled.DISPLAY_ONLY),
        CameraProperty(Code.OBJECTS_IN_MEMORY, _U16, 0, (), enabled=Enabled.DISPLAY_ONLY),
        CameraProperty(Code.BATTERY, _I8, 87, limits=(-1, 100, 1), enabled=Enabled.DISPLAY_ONLY),
        CameraProperty(Code.ISO, _U32, 400, _ISO),
        CameraProperty(Code.CAPTURE_TARGET, _U16, TARGET_COMPUTER, (TARGET_COMPUTER, TARGET_BOTH, TARGET_CARD)),
        CameraProperty(Code.FOCUS_CAN_BE_DRIVEN, _U8, 1, (), enabled=Enabled.DISPLAY_ONLY),
        CameraProperty(Code.FOCAL_POSITION, _U8, 50, limits=(0, 100, 1), enabled=Enabled.DISPLAY_ONLY),
        CameraProperty(Code.JPEG_QUALITY, _U8, 2, (1, 2, 3, 4)),
        CameraProperty(Code.FILE_FORMAT, _U8, FILE_JPEG, (FILE_RAW, FILE_RAW_JPEG, FILE_JPEG)),
        CameraProperty(Code.PRIORITY_MODE, _U8, 0, (0, 1)),
    ]


class PropertyTable:
    """All properties behind one lock; used by the command thread and the exposure thread."""

    def __init__(self) -> None:
        self._entries = {entry.code: entry for entry in initial_properties()}
        self._lock = threading.Lock()

    def codes(self) -> tuple[int, ...]:
        """The property codes in the table's order."""
        return tuple(self._entries)

    def encode_all(self) -> bytes:
        """Encode the answer to 9209: 8-byte count, then all entries."""
        with self._lock:
            entries = [entry.encode() for entry in self._entries.values()]
        return struct.pack("<Q", len(entries)) + b"".join(entries)

    def extension_info(self) -> bytes:
        """Encode the answer to 9202: version, codes of the properties, codes of the controls."""
        codes = self.codes()
        listing = struct.pack(f"<HI{len(codes)}H", PROTOCOL_VERSION, len(codes), *codes)
        return listing + struct.pack(f"<I{len(CONTROLS)}H", len(CONTROLS), *CONTROLS)

    def set_from_client(self, code: int, data: bytes) -> None:
        """Set a value as operation 9205 does. Raises NotWritableError or RefusedValueError."""
        with self._lock:
            try:
                entry = self._entries[Code(code)]
            except (ValueError, KeyError) as error:
                raise NotWritableError(f"{code:04X}") from error
            entry.accept(entry.unpack(data))

    def put(self, code: Code, value: int) -> None:
        """Change a value from inside the camera (focus status, objects in memory, battery)."""
        with self._lock:
            self._entries[code].value = value

    def value(self, code: Code) -> int:
        """The current raw value."""
        with self._lock:
            return self._entries[code].value

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        shutter = self.value(Code.SHUTTER_SPEED)
        numerator, denominator = shutter >> 16, shutter & 0xFFFF
        return ExposureSettings(
            aperture_f=self.value(Code.F_NUMBER) / 100.0,
            exposure_s=numerator / denominator,
            exposure_fraction=(numerator, denominator),
            iso=self.value(Code.ISO) & 0xFFFFFF,
            jpeg=self.value(Code.FILE_FORMAT) != FILE_RAW,
            raw=self.value(Code.FILE_FORMAT) != FILE_JPEG,
            jpeg_level=self.value(Code.JPEG_QUALITY),
            on_card=self.value(Code.CAPTURE_TARGET) != TARGET_COMPUTER,
        )
