"""Transcribes listings of real Sony and Nikon bodies into the tables that the simulated cameras serve.

    python -m bench.cameras.listings LISTING.txt … --source "REPOSITORY, PATH" --out simulators/sony_camera/recordings

A listing is what `gphoto2 --summary` prints of a body. Codes, types, access, forms and numbers are taken over; serial
numbers, names of people, dates and free texts are not.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

_NEW = re.compile(r"\((?P<code>[0-9a-f]{4}) (?P<access>ro|rw) (?P<kind>\w+) ?\): (?P<rest>.*)")
_OLD = re.compile(
    r"\(0x(?P<code>[0-9a-f]{4})\):\((?P<access>read only|readwrite)\) \(type=0x(?P<kind>[0-9a-f]+)\) (?P<rest>.*)"
)
_CONTROL = re.compile(r"\((?:0x)?(?P<code>[0-9a-f]{4})(?: -- ---)?\): (?:PTP error|error) 2002 on query")
_ENUM = re.compile(r"Enumeration \[(?P<numbers>[-\d,]*)\] value: (?P<value>.*)")
_RANGE = re.compile(r"Range \[(?P<low>-?\d+) - (?P<high>-?\d+), step (?P<step>-?\d+)\] value: (?P<value>.*)")
_PLAIN = re.compile(r"(?:value: )?(?P<value>(?:.*\()?-?\d+\)?)$")
_TYPES = {"1": "i8", "2": "u8", "3": "i16", "4": "u16", "5": "i32", "6": "u32", "7": "i64", "8": "u64", "ffff": "str"}
_BITS = {"i8": 8, "u8": 8, "i16": 16, "u16": 16, "i32": 32, "u32": 32, "i64": 64, "u64": 64}
# Texts of a Sony that say nothing about a person: version, lens, prefix of file names. Those of others are left out.
_TEXTS = {"d040", "d07b", "d1ca"}
# GetSet and IsEnabled of an entry, where its bytes are public: a piece of the answer to 9209 in gphoto/gphoto2#641.
_BYTES = {("ILCE-7RM5", "5007"): "0/1"}
_PLAIN_PTP, _STEPPED, _DIRECT = 100, 200, 300
_ONLY_3_00 = "d253"


def transcribe(listing: str, source: str) -> str:
    """The table of a listing. Raises ValueError if it names no body."""
    nikon = re.search(r"^Manufacturer: Nikon", listing, re.MULTILINE) is not None
    model = re.search(r"^Model: (.+)$", listing, re.MULTILINE)
    firmware = re.search(r"^ *Version: (.+)$", listing, re.MULTILINE)
    if model is None or firmware is None:
        raise ValueError("the listing names no body")
    lines: dict[str, str] = {}
    controls: list[str] = []
    for line in listing.splitlines():
        if found := _CONTROL.search(line):
            controls.append(found["code"])
        elif (found := _NEW.search(line) or _OLD.search(line)) and (told := _stated(found, model[1].strip())):
            if found["code"] in lines:
                controls.append(found["code"])  # some are listed again, among the controls
            lines.setdefault(found["code"], told)
    protocol = _PLAIN_PTP if nikon else _DIRECT if _ONLY_3_00 in lines else _STEPPED
    head = (
        f"# Source: {source}",
        f"Model: {model[1].strip()}",
        f"Firmware: {firmware[1].strip()}",
        f"Protocol: {protocol}",
        f"Controls: {' '.join(dict.fromkeys(controls))}".rstrip(),
    )
    return "\n".join((*head, *lines.values())) + "\n"


def _stated(found: re.Match[str], model: str) -> str:
    """A property as a line of our table; "" where the listing cuts it off or its kind is not known."""
    kind = _TYPES.get(found["kind"], found["kind"])
    access = "rw" if found["access"] in ("rw", "readwrite") else "ro"
    head = f"{found['code']} {kind} {_BYTES.get((model, found['code']), access)}"
    if kind == "str":
        text = found["rest"].strip().strip("'") if found["code"] in _TEXTS else ""
        return f"{head} none = {text}"
    if kind not in _BITS:
        return ""
    if told := _ENUM.match(found["rest"]):
        numbers = [_within(number, kind) for number in told["numbers"].split(",") if number]
        return f"{head} {' '.join(['enum', *map(str, numbers)])} = {_number(told['value'], kind)}"
    if told := _RANGE.match(found["rest"]):
        limits = [_within(told[name], kind) for name in ("low", "high", "step")]
        return f"{head} {' '.join(['range', *map(str, limits)])} = {_number(told['value'], kind)}"
    if told := _PLAIN.match(found["rest"]):
        return f"{head} none = {_number(told['value'], kind)}"
    return ""


def _number(value: str, kind: str) -> int:
    """The raw number, which stands alone or in brackets behind its meaning."""
    found = re.search(r"\((-?\d+)\)$|^(-?\d+)$", value.strip())
    if found is None:
        raise ValueError(f"{value!r} states no number")
    return _within(found[1] or found[2], kind)


def _within(number: str, kind: str) -> int:
    """The number in its type: listings print some unsigned ones as negative, and signed bytes as 255."""
    bits = _BITS[kind]
    raw = int(number) & ((1 << bits) - 1)
    return raw - (1 << bits) if kind[0] == "i" and raw >> (bits - 1) else raw


def main() -> None:
    """Write a table for each listing, named by its body and firmware."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("listings", nargs="+", type=Path)
    parser.add_argument("--source", required=True, help="repository and folder of the listings")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    for file in args.listings:
        table = transcribe(file.read_text(encoding="utf-8", errors="replace"), f"{args.source}/{file.name}")
        fields = dict(line.split(": ", 1) for line in table.splitlines() if ": " in line)
        name = f"{fields['Model'].lower().replace(' ', '')}-{fields['Firmware'].lower()}"
        (args.out / f"{name}.txt").write_text(table, encoding="utf-8")


if __name__ == "__main__":
    main()
