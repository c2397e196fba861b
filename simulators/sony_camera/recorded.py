"""What real bodies were recorded to state, in `recordings`: one file each, with its source.

bench/cameras/listings.py wrote the files. Their form is that of `orthocapture doctor --record`, so that what anybody
recorded is served in the same way.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from simulators.recordings import recorded_device
from simulators.serve import SimulatorError
from simulators.sony_camera.properties import CONTROLS, TEXT, U16, BodyTable, CameraProperty, Code, Enabled

_FOLDER = Path(str(resources.files("simulators.sony_camera"))) / "recordings"
_TYPES = {"i8": 1, "u8": 2, "i16": 3, "u16": 4, "i32": 5, "u32": 6, "i64": 7, "u64": 8, "str": TEXT}
_SIZES = ("u8", "i8", "u16", "i16", "u32", "i32", "u64", "i64")  # the smallest first
# As libgphoto2 concluded; or the two bytes of the entry, GetSet and IsEnabled, where they are known.
_ACCESS = {"rw": (True, Enabled.ON), "ro": (False, Enabled.DISPLAY_ONLY), "0/1": (False, Enabled.ON)}
_LENS_NAME = 0xD07B
_MAKER = "Sony"


@cache
def names() -> tuple[str, ...]:
    """The recorded bodies."""
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.json")))


def recorded_table(name: str) -> BodyTable:
    """The table of a recorded body. Raises SimulatorError if there is none of this name, or it cannot be read."""
    return replayed_table(_FOLDER / f"{name}.json")


def replayed_table(file: Path, name: str = "") -> BodyTable:
    """The table of the body of this name in a recording, or of its first. Raises SimulatorError."""
    table = table_of(file, _MAKER, name)
    if any(one.code == Code.OBJECTS_IN_MEMORY for one in table.properties):
        return table
    # Every body has it, because libgphoto2 cannot wait for a file without: these listings are cut.
    memory = CameraProperty(Code.OBJECTS_IN_MEMORY, U16, 0, limits=(0, 65535, 1))
    return replace(table, properties=(*table.properties, memory))


def table_of(file: Path, maker: str, name: str = "") -> BodyTable:
    """The table of a body of this maker in a recording. Raises SimulatorError if there is none."""
    listing = recorded_device(file, "gphoto", name).listing
    if not listing["maker"].startswith(maker):
        raise SimulatorError(f"{file.name} holds a body of {listing['maker']}: another simulator serves it")
    properties = tuple(_property(one) for one in listing["properties"])
    controls = tuple(int(code, 16) for code in listing.get("controls", ())) or CONTROLS
    lens = next((str(one.value) for one in properties if one.code == _LENS_NAME), "")
    return BodyTable(listing["model"], listing["firmware"], listing["protocol"], properties, controls, lens)


def _property(stated: dict[str, Any]) -> CameraProperty:
    numbers: tuple[int, ...] = tuple(stated.get("numbers", ()))
    value, form = stated["value"], stated["form"]
    get_set, enabled = _ACCESS[stated["access"]]
    return CameraProperty(
        int(stated["code"], 16),
        _TYPES[_smallest(value, numbers) if stated["type"] == "int" else stated["type"]],
        value,
        numbers if form == "enum" else None,
        (numbers[0], numbers[1], numbers[2]) if form == "range" else None,
        enabled,
        get_set,
    )


def _smallest(value: int, numbers: tuple[int, ...]) -> str:
    """The smallest type that holds these numbers, where the recording does not tell it."""
    for kind in _SIZES:
        bits = int(kind[1:])
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if kind[0] == "i" else (0, (1 << bits) - 1)
        if all(low <= number <= high for number in (value, *numbers)):
            return kind
    return "i64"
