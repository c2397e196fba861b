"""Lists a body: its properties with types, choices and values, from what libgphoto2 prints (`gphoto2 --summary`).

libgphoto2 prints 32 KiB at most, and an ILCE-1M2 states more. What is cut off is read property by property, where the
size of numbers is not told.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Literal, cast

from drivers.errors import DeviceRefusedError
from drivers.gphoto.link import Link
from drivers.interfaces import DeviceAnswers, Listing, PtpProperty
from drivers.interfaces.answers import PropertyType

_NEW = re.compile(r"\((?P<code>[0-9a-f]{4}) (?P<access>ro|rw) (?P<kind>\w+) ?\): ?(?P<rest>.*)")
_OLD = re.compile(
    r"\(0x(?P<code>[0-9a-f]{4})\):\((?P<access>read only|readwrite)\) \(type=0x(?P<kind>[0-9a-f]+)\) (?P<rest>.*)"
)
_CONTROL = re.compile(r"\((?:0x)?(?P<code>[0-9a-f]{4})(?: -- ---)?\): (?:PTP error|error) 2002 on query")
_ENUM = re.compile(r"Enumeration \[(?P<numbers>[-\d,]*)\] value: (?P<value>.*)")
_RANGE = re.compile(r"Range \[(?P<low>-?\d+) - (?P<high>-?\d+), step (?P<step>-?\d+)\] value: (?P<value>.*)")
_PLAIN = re.compile(r"(?:value: )?(?P<value>(?:.*\()?-?\d+\)?)$")
# The raw number stands alone, or in brackets behind its meaning.
_NUMBER = re.compile(r"\((-?\d+)\)$|^(-?\d+)$")
_CODE = re.compile(r"[0-9a-f]{4}")
_TEXT = re.compile(r"(?:.*value: )?'?(?P<value>.*?)'?$")
_TYPES: dict[str, PropertyType] = {
    "1": "i8", "2": "u8", "3": "i16", "4": "u16", "5": "i32", "6": "u32", "7": "i64", "8": "u64", "ffff": "str",
}  # fmt: skip
_BITS = {"i8": 8, "u8": 8, "i16": 16, "u16": 16, "i32": 32, "u32": 32, "i64": 64, "u64": 64}
_PLAIN_PTP, _STEPPED, _DIRECT = 100, 200, 300
_ONLY_3_00 = "d253"


def list_properties(link: Link) -> DeviceAnswers:
    """List all that an open body states. Raises DeviceError if it states nothing."""
    try:
        listing = listing_of(link.summary())
    except ValueError as error:
        return DeviceAnswers(silent=(f"its properties: {error}",))
    known = {one.code for one in listing.properties} | set(listing.controls)
    further: list[PtpProperty] = []
    controls: list[str] = []
    silent: list[str] = []
    for code in sorted(name for name in link.names() if _CODE.fullmatch(name) and name not in known):
        try:
            further.append(link.unlisted(code))
        except DeviceRefusedError:
            controls.append(code)  # what is pressed or stepped has no value
    if further:
        silent.append(f"{len(further)} properties in full: the size of numbers, and digits of large ones (type int)")
    return DeviceAnswers(
        listing=listing.model_copy(
            update={
                "properties": (*listing.properties, *further),
                "controls": (*listing.controls, *controls),
                "protocol": _protocol(listing.maker, known | {one.code for one in further}),
            }
        ),
        silent=tuple(silent),
    )


def _protocol(maker: str, codes: Collection[str]) -> int:
    return _PLAIN_PTP if not maker.startswith("Sony") else _DIRECT if _ONLY_3_00 in codes else _STEPPED


def listing_of(summary: str) -> Listing:
    """The listing of a body, as far as its lines can be read. Raises ValueError if the summary names no body."""
    maker = re.search(r"^Manufacturer: (.*)$", summary, re.MULTILINE)
    model = re.search(r"^Model: (.+)$", summary, re.MULTILINE)
    firmware = re.search(r"^ *Version: (.+)$", summary, re.MULTILINE)
    if model is None or firmware is None:
        raise ValueError("the listing names no body")
    properties: dict[str, PtpProperty] = {}
    controls: list[str] = []
    for line in summary.splitlines():
        if found := _CONTROL.search(line):
            controls.append(found["code"])
        elif (found := _NEW.search(line) or _OLD.search(line)) and (told := _parse_property(found)):
            if told.code in properties:
                controls.append(told.code)  # some are listed again, among the controls
            properties.setdefault(told.code, told)
    made_by = maker[1].strip() if maker else "Sony Corporation"
    return Listing(
        maker=made_by,
        model=model[1].strip(),
        firmware=firmware[1].strip(),
        protocol=_protocol(made_by, properties),
        controls=tuple(dict.fromkeys(controls)),
        properties=tuple(properties.values()),
    )


def _parse_property(found: re.Match[str]) -> PtpProperty | None:
    """Parse a property; None where the listing cuts it off or its kind is not known."""
    kind = _TYPES.get(found["kind"], found["kind"])
    access = "rw" if found["access"] in ("rw", "readwrite") else "ro"
    code, rest = found["code"], found["rest"].strip()
    if kind == "str":
        text = _TEXT.match(rest)
        return PtpProperty(code=code, type="str", access=access, form="none", value=text["value"] if text else "")
    if kind not in _BITS:
        return None
    numbers: tuple[str, ...] = ()
    form: Literal["none", "enum", "range"] = "none"
    if told := _ENUM.match(rest):
        form, numbers = "enum", tuple(number for number in told["numbers"].split(",") if number)
    elif told := _RANGE.match(rest):
        form, numbers = "range", (told["low"], told["high"], told["step"])
    elif (told := _PLAIN.match(rest)) is None:
        return None
    if (value := _NUMBER.search(told["value"].strip())) is None:
        return None
    return PtpProperty(
        code=code,
        type=cast(PropertyType, kind),
        access=access,
        form=form,
        numbers=tuple(_within(number, kind) for number in numbers),
        value=_within(value[1] or value[2], kind),
    )


def _within(number: str, kind: str) -> int:
    """The number in its type: listings print some unsigned ones as negative, and signed bytes as 255."""
    bits = _BITS[kind]
    raw = int(number) & ((1 << bits) - 1)
    return raw - (1 << bits) if kind[0] == "i" and raw >> (bits - 1) else raw
