"""What real bodies were recorded to state, in `recordings`: one file each, with its source.

A line is a property: its code, type, access, form and value. bench/cameras/listings.py wrote the files.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path

from simulators.serve import SimulatorError
from simulators.sony_camera.properties import CONTROLS, TEXT, U16, BodyTable, CameraProperty, Code, Enabled

_FOLDER = Path(str(resources.files("simulators.sony_camera"))) / "recordings"
_TYPES = {"i8": 1, "u8": 2, "i16": 3, "u16": 4, "i32": 5, "u32": 6, "i64": 7, "u64": 8, "str": TEXT}
# As libgphoto2 concluded; or the two bytes of the entry, GetSet and IsEnabled, where they are known.
_ACCESS = {"rw": (True, Enabled.ON), "ro": (False, Enabled.DISPLAY_ONLY), "0/1": (False, Enabled.ON)}
_LENS_NAME = 0xD07B


@cache
def names() -> tuple[str, ...]:
    """The recorded bodies."""
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.txt")))


def recorded_table(name: str) -> BodyTable:
    """The table of a recorded body. Raises SimulatorError if there is none of this name, or it cannot be read."""
    table = table_of(_FOLDER / f"{name}.txt")
    if any(one.code == Code.OBJECTS_IN_MEMORY for one in table.properties):
        return table
    # Every body has it, because libgphoto2 cannot wait for a file without: these listings are cut.
    memory = CameraProperty(Code.OBJECTS_IN_MEMORY, U16, 0, limits=(0, 65535, 1))
    return replace(table, properties=(*table.properties, memory))


def table_of(file: Path) -> BodyTable:
    """The table in a file. Raises SimulatorError if it is not there."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise SimulatorError(f"no body was recorded as {file.stem}") from error
    head: dict[str, str] = {}
    properties: list[CameraProperty] = []
    for line in (one for one in lines if one and not one.startswith("#")):
        if line[0].isupper():
            key, _, value = line.partition(":")
            head[key] = value.strip()
        else:
            properties.append(_property(line))
    controls = tuple(int(code, 16) for code in head["Controls"].split()) or CONTROLS
    lens = next((str(one.value) for one in properties if one.code == _LENS_NAME), "")
    return BodyTable(head["Model"], head["Firmware"], int(head["Protocol"]), tuple(properties), controls, lens)


def _property(line: str) -> CameraProperty:
    """Parse a line such as `5007 u16 rw enum 280 320 = 800`."""
    stated, _, value = line.partition(" = ")
    code, kind, access, form, *numbers = stated.split()
    listed = tuple(int(number) for number in numbers)
    datatype = _TYPES[kind]
    get_set, enabled = _ACCESS[access]
    return CameraProperty(
        int(code, 16),
        datatype,
        value if datatype == TEXT else int(value),
        listed if form == "enum" else None,
        (listed[0], listed[1], listed[2]) if form == "range" else None,
        enabled,
        get_set,
    )
