"""Transcribes what is public of real Canon EOS bodies into recordings that the simulated camera serves.

Some listings hold the events that a body sent when remote control
began, as libgphoto2 logged them: codes and numbers. Others hold its settings, as `gphoto2 --list-all-config` words
them: canon_words.py has the codes and numbers. What neither gives is named in the recording. Serial numbers, names
and dates are taken out.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from drivers.interfaces import DeviceAnswers, Listing, PtpProperty
from drivers.interfaces.answers import PropertyType
from drivers.recording import RecordedDevice, Recording
from drivers.recording.personal_data import without_personal_data
from tests.support.recorded.canon_words import (
    CODES,
    DATES,
    EVERY_BODY,
    HALF,
    IMAGE_FORMATS,
    LOSSLESS,
    NO_FILE,
    NO_PROPERTY,
    RAW_BIT,
    SETTINGS,
    STEPS_PER_STOP,
    TEXTS,
    Setting,
)
from tests.support.recorded.canon_words import FILES as FORMATS

_PLAIN_PTP = 100
_OF_EXPOSURE = {0xD101, 0xD102, 0xD103, 0xD105}  # aperture, time, ISO, program
_NAMED = r"(?P<code>d1[0-9a-f]{2})(?: \([^)]*\))?"
_EVENT = re.compile(r"event (?P<number>\d+):")
_TOLD = re.compile(rf"event \d+: EOS prop {_NAMED} info record")
_VALUE = re.compile(rf"event \d+:.* currentvalue of {_NAMED} is ?(?P<value>.*)")
_OFFERS = re.compile(rf"event \d+: EOS prop {_NAMED} desc record, datasize \d+, propxtype 3")
_TYPE = re.compile(r"event \d+: propxtype is 3, prop is 0x(?P<code>d1[0-9a-f]{2}), data type is 0x(?P<kind>\d{4})")
_OFFERED = re.compile(rf"event \d+: suppval\[\d+\] of {_NAMED} is (?:0x)?(?P<value>[0-9a-f]+)")
_TYPES: Mapping[str, PropertyType] = {
    "0001": "i8", "0002": "u8", "0003": "i16", "0004": "u16", "0005": "i32", "0006": "u32",
}  # fmt: skip
_SETTING = re.compile(r"^/main/\S+/(?P<name>[^/\n]+?)\s*\n(?P<body>(?:(?!/main/|END).*\n?)*)", re.MULTILINE)
_CURRENT = re.compile(r"^Current: ?(.*?)\s*$", re.MULTILINE)
_CHOICE = re.compile(r"^Choice: \d+ ?(.*?)\s*$", re.MULTILINE)
_UNKNOWN = re.compile(r"Unknown value ([0-9a-f]{4})")


@dataclass(slots=True)
class Told:
    """What a listing gives of a body, and in words what it does not."""

    properties: dict[int, PtpProperty] = field(default_factory=dict[int, PtpProperty])
    lacks: list[str] = field(default_factory=list[str])


def from_events(log: Iterable[str]) -> Told:
    """What a body told when remote control began: until the events are counted anew."""
    values: dict[int, str] = {}
    choices: dict[int, list[int]] = {}
    kinds: dict[int, PropertyType] = {}
    every: dict[int, None] = {}
    last = -1
    for line in log:
        if (event := _EVENT.search(line)) is None:
            continue
        if int(event["number"]) < last:
            break
        last = int(event["number"])
        if told := _TOLD.search(line):
            every[int(told["code"], 16)] = None
        elif told := _VALUE.search(line):
            values.setdefault(int(told["code"], 16), told["value"].strip())
        elif told := _OFFERS.search(line):
            choices[int(told["code"], 16)] = []  # some are told twice
        elif told := _TYPE.search(line):
            kinds[int(told["code"], 16)] = _TYPES.get(told["kind"], "u32")
        elif told := _OFFERED.search(line):
            choices.setdefault(int(told["code"], 16), []).append(int(told["value"], 16))
    found = Told()
    for code, value in values.items():
        kind = CODES[code].type if code in CODES else kinds.get(code, "u32")
        if code in DATES:
            continue
        if code in TEXTS:
            found.properties[code] = _property(code, "str", value)
        elif re.fullmatch("[0-9a-f]+", value):
            found.properties[code] = _property(code, kind, int(value, 16), choices.get(code))
    unread = ", ".join(f"{code:04x}" for code in every if code not in found.properties.keys() | DATES)
    found.lacks += [f"numbers of properties that its log has as bytes: {unread}"] if unread else []
    return found


def from_settings(listing: str) -> Told:
    """What the words of a body's settings stand for."""
    found = Told()
    further: list[str] = []
    for told in _SETTING.finditer(listing):
        name, current = told["name"], _CURRENT.search(told["body"])
        if current is None or name in NO_PROPERTY or re.fullmatch("[d5][0-9a-f]{3}", name):
            continue
        if name not in SETTINGS:
            further.append(name)
            continue
        setting, offered = SETTINGS[name], _CHOICE.findall(told["body"])
        if setting.type == "str":
            found.properties[setting.code] = _property(setting.code, "str", current[1])
            continue
        numbers = _numbers(setting, offered)
        value = _number(setting, current[1], halves=_has_halves(setting, offered))
        unknown = [word for word, number in zip(offered, numbers, strict=True) if number is None]
        if value is None:
            found.lacks.append(f"the number of {name} {current[1]}")
            continue
        if unknown:
            found.lacks.append(f"numbers that {name} offers: {', '.join(unknown)}")
        known = [number for number in numbers if number is not None]
        found.properties[setting.code] = _property(setting.code, setting.type, value, known if offered else None)
    found.lacks += [f"codes of settings: {', '.join(dict.fromkeys(further))}"] if further else []
    return found


def _has_halves(setting: Setting, offered: Sequence[str]) -> bool:
    """Whether a list is one of half stops: a word that only such a list has is in it."""
    alone = [word for word in offered if len(setting.words.get(word, ())) == 1]
    return any(setting.words[word][0] % STEPS_PER_STOP == HALF for word in alone)


def _numbers(setting: Setting, offered: Sequence[str]) -> list[int | None]:
    halves = _has_halves(setting, offered)
    return [_number(setting, word, halves=halves) for word in offered]


def _number(setting: Setting, word: str, *, halves: bool) -> int | None:
    """The number of a word; None if it is not known."""
    if setting.code in IMAGE_FORMATS:
        return _image_format(word)
    if unknown := _UNKNOWN.fullmatch(word):
        return int(unknown[1], 16)
    if setting.words:
        numbers = setting.words.get(word) or setting.words.get(word.lower(), ())
        matching = [number for number in numbers if (number % STEPS_PER_STOP == HALF) is halves]
        return next(iter((*matching, *numbers)), None)
    try:
        return int(word, setting.base)
    except ValueError:
        return None


def _image_format(word: str) -> int | None:
    if unknown := _UNKNOWN.fullmatch(word):
        return _two_files(int(unknown[1], 16))
    parts = [FORMATS.get(" ".join(part.split())) for part in word.split(" + ")]
    if len(parts) > 2 or any(part is None for part in parts):
        return None
    first, second = (*(part for part in parts if part is not None), NO_FILE)[:2]
    return first << 8 | second


def _two_files(number: int) -> int:
    """The number of libgphoto2 2.5.32 and later: before, a second file that is none was 0, and RAW had no bit."""
    first, second = number >> 8, number & 0xFF
    if first & 0x07 == LOSSLESS:
        first |= RAW_BIT
    return first << 8 | (second or NO_FILE)


def _property(code: int, kind: PropertyType, value: int | str, offered: Sequence[int] | None = None) -> PtpProperty:
    if isinstance(value, str):
        return PtpProperty(code=f"{code:04x}", type="str", access="ro", form="none", value=value)
    numbers = tuple(_within(number, code, kind) for number in offered or ())
    form: Literal["none", "enum"] = "none" if offered is None else "enum"
    access: Literal["rw", "ro"] = "rw" if numbers else "ro"  # what offers nothing cannot be set now
    return PtpProperty(
        code=f"{code:04x}", type=kind, access=access, form=form, numbers=numbers, value=_within(value, code, kind)
    )


def _within(number: int, code: int, kind: PropertyType) -> int:
    if code in IMAGE_FORMATS:
        return _two_files(number & 0xFFFF)
    bits = int(kind[1:])
    raw = number & ((1 << bits) - 1)
    return raw - (1 << bits) if kind[0] == "i" and raw >> (bits - 1) else raw


def transcribe(listing: str, source: str) -> Recording:
    """The recording of a listing. Raises ValueError if it names no body, or gives nothing of its settings."""
    model = re.search(r"^ *Model: (.+?)\s*$", listing, re.MULTILINE) or re.search(
        r"/status/cameramodel\n(?:.*\n){0,3}?Current: (.+)", listing
    )
    firmware = re.search(r"^ *(?:device version|Version): (.+?)\s*$", listing, re.MULTILINE) or re.search(
        r"/status/deviceversion\n(?:.*\n){0,3}?Current: (.+)", listing
    )
    maker = re.search(r"Canon(?: |\.)Inc\.?", listing)
    if model is None or firmware is None:
        raise ValueError("the listing names no body")
    events, words = from_events(listing.splitlines()), from_settings(listing)
    by, told = "the events that libgphoto2 logged", events
    if len(words.properties) > len(events.properties):
        by, told = "gphoto2 --list-all-config", words
    if not told.properties.keys() & _OF_EXPOSURE:
        raise ValueError("the listing gives neither events nor settings of an exposure")
    for code in EVERY_BODY - told.properties.keys():
        told.properties[code] = _property(code, "str", "")  # who published the listing took it out
    told_of = Listing(
        maker=maker[0] if maker else "Canon.Inc",
        model=model[1],
        firmware=firmware[1],
        protocol=_PLAIN_PTP,
        properties=tuple(told.properties.values()),
    )
    answers = DeviceAnswers(listing=told_of, silent=tuple(told.lacks))
    recorded = RecordedDevice(kind="camera", driver="gphoto", answers=answers)
    return without_personal_data(Recording(by=by, source=source, devices={"camera": recorded}))
