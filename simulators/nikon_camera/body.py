"""The Nikon body: the properties that were recorded, its card, and what it tells of new files."""

from __future__ import annotations

import threading
from functools import cache
from importlib import resources
from pathlib import Path

from simulators.faults import FaultPlan
from simulators.sony_camera.properties import BodyTable, CameraProperty
from simulators.sony_camera.recorded import table_of
from simulators.still_camera.body import BodyOptions, CameraBody, CameraFile, FileNames
from simulators.still_camera.card import FOLDER_PICTURES
from simulators.still_camera.exif import ExposureSettings, Nameplate
from simulators.still_camera.operations import NotWritableError
from simulators.still_camera.scene import ImageSource

FORMAT_NEF = 0x3000
COMPRESSION, F_NUMBER, ISO, EXPOSURE_TIME = 0x5004, 0x5007, 0x500F, 0xD100
_RAW, _BOTH = (4,), (5, 6, 7)  # compressions
_FOLDER = Path(str(resources.files("simulators.nikon_camera"))) / "recordings"
_MAKER = "Nikon"
_UNSTATED = {COMPRESSION: 2, F_NUMBER: 800, ISO: 100, EXPOSURE_TIME: 1 << 16 | 60}


@cache
def names() -> tuple[str, ...]:
    """The recorded bodies."""
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.json")))


def recorded_table(name: str) -> BodyTable:
    """The table of a recorded body. Raises SimulatorError if there is none of this name."""
    return replayed_table(_FOLDER / f"{name}.json")


def replayed_table(file: Path, name: str = "") -> BodyTable:
    """The table of the body of this name in a recording, or of its first. Raises SimulatorError."""
    return table_of(file, _MAKER, name)


class NikonBody(CameraBody):
    """A body that was recorded, whose files stay on its card."""

    def __init__(self, table: BodyTable, source: ImageSource, faults: FaultPlan, options: BodyOptions) -> None:
        self.table = table
        plate = Nameplate("NIKON CORPORATION", f"NIKON {self.table.model}", "", "6012345", self.table.firmware, 2)
        super().__init__(source, faults, options, plate, FileNames("DSC_{:04d}", ".NEF", FORMAT_NEF))
        self._properties = {entry.code: entry for entry in self.table.properties}
        self._files: dict[int, CameraFile] = {}
        self._news: list[int] = []  # handles of files of which no client has been told
        self._lock = threading.Lock()

    def codes(self) -> tuple[int, ...]:
        """The properties that it has."""
        return tuple(self._properties)

    def property(self, code: int) -> CameraProperty:
        """One property. Raises NotWritableError if it has none of this code."""
        try:
            return self._properties[code]
        except KeyError as error:
            raise NotWritableError(f"{code:04X}") from error

    def _value(self, code: int) -> int:
        entry = self._properties.get(code)
        return entry.value if entry is not None and isinstance(entry.value, int) else _UNSTATED[code]

    def exposure_settings(self) -> ExposureSettings:
        """The settings with which the next exposure will be taken."""
        f_number, time, compression = self._value(F_NUMBER), self._value(EXPOSURE_TIME), self._value(COMPRESSION)
        fraction = (time >> 16, time & 0xFFFF) if time >> 16 and time & 0xFFFF else (1, 2)
        return ExposureSettings(
            aperture_f=f_number / 100.0 or 8.0,
            exposure_s=fraction[0] / fraction[1],
            exposure_fraction=fraction,
            iso=min(self._value(ISO), 65535),
            jpeg=compression not in _RAW,
            raw=compression in (*_RAW, *_BOTH),
            on_card=True,
            states_aperture=f_number > 0,
        )

    def dial_iso(self, iso: int) -> None:
        """Turn the ISO dial by hand."""
        self.property(ISO).value = iso or _UNSTATED[ISO]

    def keep(self, files: list[CameraFile], settings: ExposureSettings) -> None:
        """Put finished files on the card, and announce them."""
        del settings
        with self._lock:
            for file in files:
                handle = FOLDER_PICTURES + 1 + len(self._files)
                self._files[handle] = file
                self._news.append(handle)

    def news(self) -> list[int]:
        """The handles of the files that are new since the last call."""
        with self._lock:
            told, self._news = self._news, []
            return told

    def file(self, handle: int) -> CameraFile | None:
        """A file on the card."""
        with self._lock:
            return self._files.get(handle)

    def on_card(self) -> tuple[int, ...]:
        """The handles of the files on the card."""
        with self._lock:
            return tuple(self._files)
