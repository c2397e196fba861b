"""The properties of a simulated Canon EOS R5: codes, what it offers, and what they are now."""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from simulators.canon_camera import events
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.operations import NotWritableError, RefusedValueError


class Code(IntEnum):
    """Property codes."""

    APERTURE = 0xD101
    SHUTTER = 0xD102
    ISO = 0xD103
    EXPOSURE_COMPENSATION = 0xD104
    EXPOSURE_MODE = 0xD105
    DRIVE = 0xD106
    FOCUS = 0xD108
    WHITE_BALANCE = 0xD109
    BATTERY = 0xD111
    AVAILABLE_SHOTS = 0xD11B
    DESTINATION = 0xD11C
    STORAGE = 0xD11E
    IMAGE_FORMAT = 0xD120
    SERIAL = 0xD1AF
    VIEWFINDER_OUTPUT = 0xD1B0
    VIEWFINDER_MODE = 0xD1B1
    LENS = 0xD1D8


CARD, MEMORY = 2, 4  # destinations of files
MANUAL_FOCUS, ONE_SHOT = 3, 0
MANUAL_EXPOSURE, APERTURE_PRIORITY = 3, 2
_BATTERY = ((87, 2), (62, 4), (37, 1), (12, 5))  # at least so many per cent: code
_NEARLY_EMPTY = 0


def thirds(first: int, count: int) -> tuple[int, ...]:
    """Codes of values that lie a third of a stop apart: eight to a stop, of which a third has 3 and two thirds 5."""
    return tuple(first + 8 * (i // 3) + (0, 3, 5)[i % 3] for i in range(count))


_APERTURES = (2.8, 3.2, 3.5, 4, 4.5, 5, 5.6, 6.3, 7.1, 8, 9, 10, 11, 13, 14, 16, 18, 20, 22)
_SECONDS = (30, 25, 20, 15, 13, 10, 8, 6, 5, 4, 3.2, 2.5, 2, 1.6, 1.3, 1, 0.8, 0.6, 0.5, 0.4, 0.3)
_FRACTIONS = (
    *(4, 5, 6, 8, 10, 13, 15, 20, 25, 30, 40, 50, 60, 80, 100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000),
    *(1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400, 8000),
)
_ISOS = (
    *(100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400),
    *(8000, 10000, 12800),
)
APERTURE_F = dict(zip(thirds(0x20, len(_APERTURES)), _APERTURES, strict=True))
ISO = dict(zip(thirds(0x48, len(_ISOS)), _ISOS, strict=True))
SHUTTER = dict(
    zip(
        thirds(0x10, len(_SECONDS) + len(_FRACTIONS)),
        [(round(10 * s), 10) for s in _SECONDS] + [(1, n) for n in _FRACTIONS],
        strict=True,
    )
)


# From +3 to -3 by thirds of a stop, in signed bytes; with the dial on M they change no picture.
_ABOVE_ZERO = thirds(0, 10)[:0:-1]
COMPENSATIONS = (*_ABOVE_ZERO, 0, *((-code) & 0xFF for code in reversed(_ABOVE_ZERO)))


@dataclass(frozen=True, slots=True)
class ImageFormat:
    """The files of an exposure: (type, size, compression) of one or two of them."""

    parts: tuple[tuple[int, int, int], ...]

    def encode(self) -> bytes:
        """Count, then for each file the size of its entry and the three numbers."""
        return struct.pack("<I", len(self.parts)) + b"".join(struct.pack("<IIII", 16, *part) for part in self.parts)


JPEG_LARGE, JPEG_LARGE_NORMAL, RAW = (1, 0, 3), (1, 0, 2), (6, 0, 4)
_COMBINATIONS = ((JPEG_LARGE,), (JPEG_LARGE_NORMAL,), (RAW, JPEG_LARGE), (RAW, JPEG_LARGE_NORMAL), (RAW,))
FORMATS = tuple(ImageFormat(parts) for parts in _COMBINATIONS)


@dataclass(slots=True)
class _Number:
    value: int
    choices: tuple[int, ...] = ()
    writable: bool = True


def _initial() -> dict[Code, _Number]:
    """After power-on, with the dial on M: f/8, 1/60 s, ISO 400, daylight, files to the card."""
    return {
        Code.APERTURE: _Number(0x38, tuple(APERTURE_F)),
        Code.SHUTTER: _Number(0x68, tuple(SHUTTER)),
        Code.ISO: _Number(0x58, (0, *ISO)),
        Code.EXPOSURE_COMPENSATION: _Number(0, COMPENSATIONS),
        Code.EXPOSURE_MODE: _Number(MANUAL_EXPOSURE, writable=False),
        Code.DRIVE: _Number(0, (0, 0x12, 0x04, 0x05, 0x10, 0x11)),
        Code.FOCUS: _Number(MANUAL_FOCUS, (0, 1), writable=False),
        Code.WHITE_BALANCE: _Number(1, (0, 23, 1, 8, 2, 3, 4, 5, 6, 9)),
        Code.BATTERY: _Number(2, writable=False),
        Code.AVAILABLE_SHOTS: _Number(0, writable=False),
        Code.DESTINATION: _Number(CARD, (CARD, MEMORY)),
        Code.STORAGE: _Number(0x00010001, writable=False),
        Code.VIEWFINDER_OUTPUT: _Number(1, (0, 1, 2, 3)),
        Code.VIEWFINDER_MODE: _Number(1, (0, 1)),
    }


class Properties:
    """All properties and the event records that tell of them; used by several threads."""

    def __init__(self, serial: str, lens: str) -> None:
        self._numbers = _initial()
        self._format = FORMATS[0]
        self._texts = {Code.SERIAL: serial, Code.LENS: lens}
        self._lock = threading.Lock()
        self._news = bytearray()

    def announce(self, record: bytes) -> None:
        """Add a record to the next answer to GetEvent."""
        with self._lock:
            self._news += record

    def news(self) -> bytes:
        """All records since the last call, with the closing one."""
        with self._lock:
            said, self._news = bytes(self._news), bytearray()
        return said + events.END

    def announce_all(self) -> None:
        """Tell values and choices of everything, as at the beginning of remote control."""
        with self._lock:
            for code, entry in self._numbers.items():
                self._news += self._value_of(code)
                if entry.choices:
                    packed = struct.pack(f"<{len(entry.choices)}I", *entry.choices)
                    self._news += events.choices(code, len(entry.choices), packed)
            self._news += self._value_of(Code.IMAGE_FORMAT)
            listing = b"".join(one.encode() for one in FORMATS)
            self._news += events.choices(Code.IMAGE_FORMAT, len(FORMATS), listing)
            for code in self._texts:
                self._news += self._value_of(code)

    def _value_of(self, code: Code) -> bytes:
        if code in self._texts:
            return events.value(code, self._texts[code].encode("ascii") + b"\0")
        if code is Code.IMAGE_FORMAT:
            return events.value(code, self._format.encode())
        return events.value(code, struct.pack("<I", self._numbers[code].value))

    def tell(self, number: int) -> None:
        """Tell the value of one property again. Raises NotWritableError if there is none."""
        with self._lock:
            self._news += self._value_of(self._code_of(number))

    def _code_of(self, number: int) -> Code:
        try:
            return Code(number)
        except ValueError as error:
            raise NotWritableError(f"{number:04X}") from error

    def set_from_client(self, data: bytes) -> None:
        """Set a value: size, code, value. Raises NotWritableError or RefusedValueError."""
        if len(data) < 12 or struct.unpack_from("<I", data)[0] != len(data):
            raise RefusedValueError(f"{len(data)} bytes are not a value")
        code = self._code_of(struct.unpack_from("<I", data, 4)[0])
        if code is Code.IMAGE_FORMAT:
            chosen = next((one for one in FORMATS if one.encode() == data[8:]), None)
            if chosen is None:
                raise RefusedValueError("no such image format")
            self._format = chosen
        else:
            self._accept(code, int(struct.unpack_from("<I", data, 8)[0]))
        self.tell(code)

    def _accept(self, code: Code, value: int) -> None:
        entry = self._numbers.get(code)
        if entry is None or not entry.writable:
            raise NotWritableError(code.name)
        if entry.choices and value not in entry.choices:
            raise RefusedValueError(f"{code.name} does not offer {value}")
        exposure = code in (Code.APERTURE, Code.SHUTTER)
        if exposure and self._numbers[Code.EXPOSURE_MODE].value != MANUAL_EXPOSURE:
            raise NotWritableError(f"{code.name}: the mode dial is not on M")
        entry.value = value

    def put(self, code: Code, value: int) -> None:
        """Change a value from inside the camera, and tell it."""
        with self._lock:
            self._numbers[code].value = value
            self._news += self._value_of(code)

    def offer(self, code: Code, choices: tuple[int, ...]) -> None:
        """Offer only these values from now on, and take the first of them."""
        self._numbers[code].choices = choices
        self.put(code, choices[0])

    def charge(self, percent: int) -> None:
        """Set the charge of the battery, of which the camera only tells quarters."""
        self.put(Code.BATTERY, next((code for least, code in _BATTERY if percent >= least), _NEARLY_EMPTY))

    def value(self, code: Code) -> int:
        """The current number."""
        with self._lock:
            return self._numbers[code].value

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        fraction = SHUTTER[self.value(Code.SHUTTER)]
        kinds: Sequence[tuple[int, int, int]] = self._format.parts
        jpeg = next((part for part in kinds if part[0] == JPEG_LARGE[0]), None)
        return ExposureSettings(
            aperture_f=APERTURE_F[self.value(Code.APERTURE)],
            exposure_s=fraction[0] / fraction[1],
            exposure_fraction=fraction,
            iso=ISO.get(self.value(Code.ISO), 400),
            jpeg=jpeg is not None,
            raw=RAW in kinds,
            jpeg_level=3 if jpeg == JPEG_LARGE_NORMAL else 1,
            on_card=self.value(Code.DESTINATION) == CARD,
        )
