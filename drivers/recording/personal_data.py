"""What a recording of devices must not say: one table of personal data, and how each is taken out.

Headers of files come without it already: those of DICOM files hold what `drivers.dicom_folder.deidentify` keeps,
those of meshes no free text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from drivers.interfaces.answers import SERIES_DESCRIPTION
from drivers.recording import Recording

Secrets = Mapping[str, str]  # a text that must not appear: what it is, one of the names in TABLE
_SHORTEST = 4  # characters of a text that is looked for everywhere; a shorter one is part of other words
_NOT_SECRET = ("usb:", "localhost")


@dataclass(frozen=True, slots=True)
class Taken:
    """A kind of personal data: `(NAME 1)` stands instead of the first that is found, and so on."""

    name: str
    what: str
    pattern: re.Pattern[str] | None = None  # of what is recognised in any text


_OCTET = r"(?:25[0-5]|2[0-4]\d|1?\d?\d)"
_NAME = r"[^\s/\\:*?\"'<>|,;]+"  # a word of a path, whose folders and files may have several
# The order counts: an address may stand within a path, and a path within a longer text.
TABLE = (
    Taken("serial number", "serial numbers, and the names that owners give to devices"),
    Taken("program", "names of programs on a pendant"),
    Taken("file", "names of files and folders where devices export"),
    Taken("description", "descriptions of CT series"),
    Taken("e-mail", "e-mail addresses", re.compile(r"[\w.+-]+@[\w-]+(?:\.[\w-]+)+")),
    Taken("UID", "UIDs of DICOM", re.compile(r"(?<![\w.])[0-2](?:\.\d+){5,}(?![\w.])")),
    Taken(
        "address",
        "addresses and names of hosts",
        re.compile(
            rf"(?:\b\w+:)?(?<![\w.]){_OCTET}(?:\.{_OCTET}){{3}}(?![\w]|\.\w)(?::\d+)*"
            r"|\b(?:[0-9A-Fa-f]{2}[:-]){5}[0-9A-Fa-f]{2}\b|(?<![\w:])(?:[0-9A-Fa-f]{1,4}:){4,}[0-9A-Fa-f:]+"
        ),
    ),
    Taken(
        "path",
        "paths of files and folders",
        re.compile(
            rf"(?<![\w/\\.])(?:~|[A-Za-z]:|\\|file:/)?(?:[/\\]{_NAME}){{2,}}[/\\]?"
            rf"(?:(?: {_NAME}){{1,3}}[/\\](?:{_NAME})?)*(?:(?: {_NAME}){{0,2}} {_NAME}\.\w{{2,4}}\b)?"
        ),
    ),
)
TEXTS = "texts of a camera that its owner writes: artist, copyright, comments, date"
FILES = "what names a patient or a person in the headers of files"
# Texts of a body that nobody writes: Sony's version, lens and prefix of file names; the lenses of the others.
_KEPT_TEXTS = {"Sony": {"d040", "d07b", "d1ca"}, "Nikon": {"d0e3"}, "Canon": {"d1d8"}}
_PROGRAM = re.compile(r"(?:Loaded program: |true |false |[A-Z]+ )?(?P<name>.+)$")
_NO_PROGRAM = ("<unnamed>", "No program loaded")
_SERIAL_FIELD = re.compile(r'"serial": "(?P<serial>[^"]+)"')
_VERSION_WITH_NAME = re.compile(r"VER:[^:]*:(?P<name>[^\]]+)")


def without_personal_data(recording: Recording, secrets: Secrets | None = None) -> Recording:
    """The recording without what TABLE names; `secrets` are texts that the rig file or a folder told."""
    known = {text: what for text, what in (*(secrets or {}).items(), *_find_secrets(recording)) if _is_worth(text)}
    mask = _Mask(known)
    data = recording.model_dump(mode="json", exclude_defaults=True)
    for device in data["devices"].values():
        if report := device.get("report"):
            identity = report["identity"]
            identity["serial"] = mask.whole(identity["serial"], "serial number")
            identity["address"] = mask.whole(identity["address"], "address")
            report["details"] = {key: mask.text(value) for key, value in report.get("details", {}).items()}
            report["problems"] = [mask.text(text) for text in report.get("problems", ())]
        if "error" in device:
            device["error"] = mask.text(device["error"])
        _clean_answers(device.get("answers", {}), mask)
    taken = (*(one.what for one in TABLE), TEXTS, FILES)
    return Recording.model_validate(data | {"taken_out": taken})


def _clean_answers(answers: Any, mask: _Mask) -> None:
    for exchange in answers.get("exchanges", ()):
        exchange["answer"] = mask.text(exchange["answer"])
    answers |= {"silent": [mask.text(text) for text in answers["silent"]]} if "silent" in answers else {}
    for header in answers.get("headers", ()):
        header["lines"] = [mask.line(line) for line in header["lines"]]
    if listing := answers.get("listing"):
        kept = next((codes for maker, codes in _KEPT_TEXTS.items() if listing["maker"].startswith(maker)), set[str]())
        for one in listing["properties"]:
            if one["type"] == "str":
                one["value"] = mask.text(one["value"]) if one["code"] in kept else ""


def _find_secrets(recording: Recording) -> Iterator[tuple[str, str]]:
    """Find what devices told of themselves, each with its kind."""
    for device in recording.devices.values():
        if device.report is not None:
            yield device.report.identity.serial, "serial number"
            yield device.report.identity.address, "address"
        for line in (line for header in device.answers.headers for line in header.lines):
            if line.startswith(SERIES_DESCRIPTION):
                yield line.removeprefix(SERIES_DESCRIPTION), "description"
        for exchange in device.answers.exchanges:
            yield from _find_in_answer(exchange.question.lower(), exchange.answer)


def _find_in_answer(question: str, answer: str) -> Iterator[tuple[str, str]]:
    if "serial" in question:
        yield answer, "serial number"
    elif question == "greeting":  # of a KUKA, which has no report if it was refused for its model
        yield from ((found["serial"], "serial number") for found in _SERIAL_FIELD.finditer(answer))
    elif question.startswith("*idn"):
        yield from ((part.strip(), "serial number") for part in answer.split(",")[2:3])
    elif "program" in question and (found := _PROGRAM.match(answer)) and found["name"] not in _NO_PROGRAM:
        yield found["name"], "program"
    elif found := _VERSION_WITH_NAME.search(answer):
        yield found["name"], "serial number"


def _is_worth(text: str) -> bool:
    return len(text) >= _SHORTEST and text not in _NOT_SECRET


class _Mask:
    """Replaces texts; the same text by the same placeholder in the whole recording."""

    def __init__(self, secrets: Secrets) -> None:
        self._names: dict[tuple[str, str], str] = {}
        self._counts: dict[str, int] = {}
        self._literals = sorted(secrets.items(), key=lambda one: (-len(one[0]), one[0]))  # the longest first

    def whole(self, text: str, what: str) -> str:
        """A placeholder for a whole text, if there is one."""
        return self._placeholder(text, what) if text else ""

    def line(self, line: str) -> str:
        """A line of a header."""
        if line.startswith(SERIES_DESCRIPTION):
            return SERIES_DESCRIPTION + self.whole(line.removeprefix(SERIES_DESCRIPTION), "description")
        return self.text(line)

    def literals(self, text: str) -> str:
        """A text without what is known to be secret."""
        for literal, what in self._literals:
            if literal in text:  # a folder may hold as many names as a series has slices
                text = re.sub(rf"(?<!\w){re.escape(literal)}(?!\w)", self._replacing(what), text)
        return text

    def text(self, text: str) -> str:
        """A text without what is known to be secret, and without what looks like it."""
        text = self.literals(text)
        for one in TABLE:
            text = one.pattern.sub(self._replacing(one.name), text) if one.pattern else text
        return text

    def _replacing(self, what: str) -> Callable[[re.Match[str]], str]:
        return lambda found: self._placeholder(found[0], what)

    def _placeholder(self, text: str, what: str) -> str:
        if (what, text) not in self._names:
            self._counts[what] = self._counts.get(what, 0) + 1
            self._names[what, text] = f"({what} {self._counts[what]})"
        return self._names[what, text]


def named(texts: Iterable[str], what: str) -> dict[str, str]:
    """Secrets of one kind."""
    return dict.fromkeys(texts, what)
