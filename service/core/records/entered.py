"""What people enter: names, reasons, what a run is for, and notes on its steps. Plain text of bounded length."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Field

from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.records.base import ArtefactRef, Record

# What a person's name is, wherever one enters; and which names look alike.
#
# A name is stored in Unicode's form NFKC, and every word of it has letters of one script. The look-alikes are those
# of Unicode's table (UTS 39, confusables.txt) that are letters of living languages: Latin, Greek and Cyrillic, and
# digits.


NAME_CHARACTERS = 80
REMEDY = (
    f"Use up to {NAME_CHARACTERS} letters, digits, single blanks and . _ - ' @ , ( ) & + /, a letter or digit first, "
    "and letters of one alphabet in each word"
)
# Actors of events that the software writes by itself, and words that would be read as such.
RESERVED = frozenset(
    {
        *("web", "runner", "worker", "site", "service", "store", "orthocapture", "system", "claimed"),
        *("camera", "robot", "nobody"),
    }
)
_BETWEEN = frozenset(" ._-'@,()&+/")
_SAME = str.maketrans({**dict.fromkeys("’‘ʼʻ`´", "'"), **dict.fromkeys("‐‑‒–—−", "-")})
# Latin letters of living alphabets; with marks on them, they count as well.
_LATIN = frozenset("abcdefghijklmnopqrstuvwxyzæœøðþđħıłŋſßəŧɓɗƙƴɛɔ")
_IN_USE = {"CYRILLIC": range(0x0400, 0x0530), "GREEK": range(0x0370, 0x0400)}  # without phonetic and historic letters
_EAST_ASIAN = frozenset({"CJK", "HIRAGANA", "KATAKANA", "KATAKANA-HIRAGANA", "HANGUL", "BOPOMOFO", "IDEOGRAPHIC"})
# Letters and what they look like. l, 1 and i go together, because a capital i looks like l.
_LOOKS = str.maketrans(
    {
        **dict(zip("авегзкмнопрстухьіѕјһԁԛԝѵүӏ", "aber3kmhonpctyxblsjhdqwvyl", strict=True)),  # Cyrillic
        **dict(zip("αβγεζηικμνορσςτυχωϲϳ", "abyezhlkmvopoctuxwcj", strict=True)),  # Greek
        **dict(zip("øłđıſŧħɓɗƙƴəɛ01i", "oldlfthbdkyeeoll", strict=True)),
    }
)
_ABOVE_AND_BELOW = 200  # combining classes of accents; smaller ones belong to letters, as in Kana and Devanagari
# Characters that nobody sees, though they count as letters or marks (Default_Ignorable_Code_Point).
_UNSEEN = frozenset(
    chr(point)
    for points in (
        (0x034F, 0x115F, 0x1160, 0x17B4, 0x17B5, 0x3164, 0xFFA0),
        range(0x180B, 0x1810),
        range(0xFE00, 0xFE10),
        range(0xE0100, 0xE01F0),
    )
    for point in points
)


def person_name(typed: str) -> str:
    """Return the name that was typed, in the one format in which names are stored.

    Raises ConfigurationError if it is not a person's name, or one that the software itself acts under.
    """
    name = " ".join(part for part in _same_form(typed).split(" ") if part)
    fault = next(_faults(name), "")
    if fault:
        raise ConfigurationError(f"this cannot be a person's name: {fault}", where="name", remedy=REMEDY)
    return name


def cleaned_name(typed: str) -> str:
    """Return a typed name without everything that no name has; "unknown" if nothing is left.

    It serves what must never be refused because of a name, such as a pause.
    """
    kept = "".join(c for c in _same_form(typed) if c in _BETWEEN or not _unusual(c))
    return " ".join(kept.split())[:NAME_CHARACTERS].strip() or "unknown"


def looks_of(name: str) -> str:
    """Return a name's looks: two different names with the same looks may be mistaken for each other."""
    plain = unicodedata.normalize("NFKD", _same_form(name).casefold())
    bare = "".join(c for c in plain if unicodedata.combining(c) < _ABOVE_AND_BELOW).translate(_LOOKS)
    return bare.replace("rn", "m").replace("vv", "w")


def _same_form(typed: str) -> str:
    return unicodedata.normalize("NFKC", typed.translate(_SAME))


def _faults(name: str) -> Iterator[str]:
    """Yield why a text is no name; nothing if it is one."""
    if not name:
        yield "it is empty"
        return
    if len(name) > NAME_CHARACTERS:
        yield f"it has {len(name)} characters"
    for character in name:
        why = "" if character in _BETWEEN else _unusual(character)
        if why:
            yield f"U+{ord(character):04X} {why}"
    if not name[0].isalnum():
        yield "it begins with neither a letter nor a digit"
    if not any(c.isalpha() for c in name):
        yield "it has no letter"
    for word in name.split(" "):
        scripts = {_script(c) for c in word if c not in _BETWEEN and not c.isdecimal()} - {"COMBINING"}
        if len(scripts) > 1:
            yield f"it mixes letters of several alphabets in one word ({', '.join(sorted(scripts))})"
    if looks_of(name) in _LOOKS_RESERVED:
        yield "the software itself acts under that name, or one that looks like it"
    if _has_stacked_marks(name):
        yield "it has marks without a letter, or many on one"


def _unusual(character: str) -> str:
    """Return why no name has this character, apart from those between its parts; "" if names have it."""
    category, script = unicodedata.category(character), _script(character)
    base = unicodedata.normalize("NFKD", character)[0]
    if category == "Nd" and not character.isascii():
        return "is a digit of another script"
    if category not in ("Ll", "Lu", "Lt", "Lo", "Lm", "Mn", "Mc", "Nd"):
        return "is neither a letter nor a digit"
    if character in _UNSEEN or unicodedata.combining(character) == 1:
        return "cannot be seen, or strikes a letter through"
    if script == "LATIN" and base.lower() not in _LATIN:
        return "is a phonetic or historic letter"
    if ord(base) not in _IN_USE.get(script, (ord(base),)):
        return "is a phonetic or historic letter"
    return "is a modifier letter" if category == "Lm" and script != "EAST ASIAN" else ""


def _script(character: str) -> str:
    """Return a letter's script, which the first word of its Unicode name gives; those of East Asia are one."""
    first = unicodedata.name(character, "UNNAMED").split()[0]
    return "EAST ASIAN" if first in _EAST_ASIAN else first


def _has_stacked_marks(name: str) -> bool:
    row = 0
    for before, character in zip(f" {name}", name, strict=False):
        row = row + 1 if unicodedata.category(character) == "Mn" else 0
        if row > 2 or (row == 1 and unicodedata.category(before)[0] not in "LM"):
            return True
    return False


_LOOKS_RESERVED = frozenset(map(looks_of, RESERVED))


REASON_CHARACTERS = 2000


def reason_of(typed: str, error: type[OrthocaptureError]) -> str:
    """Return the reason without outer blanks. Raises this error if it says nothing, or more than anybody reads."""
    plain = typed.strip()
    if not plain or len(plain) > REASON_CHARACTERS:
        raise error(
            f"the reason has {len(plain)} characters" if plain else "a reason is needed",
            where="reason",
            remedy=f"Say why, in up to {REASON_CHARACTERS} characters; it goes into the record",
        )
    return plain


LINE_CHARACTERS = 200
TEXT_CHARACTERS = 4000
_Line = Annotated[str, Field(max_length=LINE_CHARACTERS)]
_Text = Annotated[str, Field(max_length=TEXT_CHARACTERS)]


class RunAbout(Record):
    """Specimen, purpose and remarks of a run as entered at its start; "" for fields left empty.

    A person who begins a run names its specimen. It may be missing in runs of older versions, and in those on a
    simulated rig that nobody attends.
    """

    specimen: _Line = ""
    purpose: _Line = ""
    site: _Line = ""
    operator: _Line = ""  # the person at the rig; the account that started the run is in its first event
    text: _Text = ""


class NoteTaken(Record):
    """A person's note on a step: text, a photograph or both. It has no effect on the run."""

    kind: Literal["note_taken"] = "note_taken"
    step: str
    attempt: int
    text: _Text = ""
    photograph: ArtefactRef | None = None
    via: Literal["web", "cli"]


# Field → its label, in the order shown.
ABOUT: Mapping[str, str] = {
    "specimen": "Specimen",
    "purpose": "Purpose",
    "site": "Site",
    "operator": "Operator",
    "text": "Remarks",
}


def about_run(
    *, specimen: str = "", purpose: str = "", site: str = "", operator: str = "", text: str = ""
) -> RunAbout:
    """Clean up what was entered.

    Raises ConfigurationError, naming the field, if a text is too long, or the operator's name is no person's name.
    """
    return RunAbout(
        specimen=line(specimen, "the specimen"),
        purpose=line(purpose, "the purpose"),
        site=line(site, "the site"),
        operator=person_name(operator) if operator.strip() else "",
        text=paragraphs(text, "the remarks"),
    )


def require_specimen(about: RunAbout) -> None:
    """Raise ConfigurationError if the specimen is not named: nobody could say later what was captured."""
    if not about.specimen:
        raise ConfigurationError(
            "the specimen is not named",
            where="specimen",
            remedy="Enter its name or number. It goes into the first record of the run, which cannot be changed "
            "afterwards",
        )


def about_rows(about: RunAbout | None) -> list[tuple[str, str]]:
    """Return (label, text) of each field that was filled in; empty for a run without them."""
    if about is None:
        return []
    return [(name, value) for field, name in ABOUT.items() if (value := str(getattr(about, field)))]


def line(entered: str, what: str) -> str:
    """Return `entered` as one line without control characters.

    Raises ConfigurationError, which calls the text `what`, if it is longer than LINE_CHARACTERS.
    """
    return _bounded(" ".join(_plain(entered).split()), what, LINE_CHARACTERS)


def paragraphs(entered: str, what: str) -> str:
    """Return `entered` without control characters, and with its line breaks.

    Raises ConfigurationError, which calls the text `what`, if it is longer than TEXT_CHARACTERS.
    """
    lines = (" ".join(each.split()) for each in _plain(entered).split("\n"))
    return _bounded("\n".join(lines).strip(), what, TEXT_CHARACTERS)


def _plain(entered: str) -> str:
    # No control characters, which a terminal would act on, and no lone surrogates, which have no canonical form.
    lines = entered.replace("\r\n", "\n").replace("\r", "\n")
    return "".join(c if c == "\n" or unicodedata.category(c) not in ("Cc", "Cs") else " " for c in lines)


def _bounded(text: str, what: str, most: int) -> str:
    if len(text) > most:
        raise ConfigurationError(
            f"{what} has {len(text)} characters; at most {most} are recorded",
            remedy="Use fewer words",
        )
    return text
