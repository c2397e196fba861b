"""Text for people: counts and times of day; and text from outside, made safe to print and to record.

Names, paths, notes and messages of devices come from outside. A terminal obeys escape sequences in them, and a
database of another kind refuses NUL and surrogates. Such characters become escapes that can be read, such as `\\x1b`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import cast

# Control characters; marks that have no width or turn the direction of writing; line separators; surrogates; tags.
# The verifier in bundles, which stands alone, escapes the same ones.
_OBEYED = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]"
    r"|[\ud800-\udfff\U000e0000-\U000e007f]"
)
_BEYOND_JSON = re.compile(_OBEYED.pattern.replace(r"\x00-\x1f", "", 1))
_NOT_TO_STORE = re.compile(r"[\x00\ud800-\udfff]")
_CONTINUED = "\n    "


def shown(text: str) -> str:
    """Return one line for a terminal, with an escape for every character that a terminal would obey."""
    if text.isascii() and text.isprintable():
        return text
    return _OBEYED.sub(_escaped, text)


def shown_lines(text: str) -> str:
    """Return lines for a terminal; each is escaped, and the line breaks stay."""
    return "\n".join(map(shown, text.split("\n")))


def shown_continued(text: str) -> str:
    """Return `shown_lines` with the lines after the first indented, so that a text from outside begins no line."""
    return shown_lines(text).replace("\n", _CONTINUED)


def shown_json(text: str) -> str:
    """Return JSON with \\u escapes for those characters that JSON leaves as they are and a terminal would obey."""
    return text if text.isascii() and text.isprintable() else _BEYOND_JSON.sub(_json_escaped, text)


def storable(text: str) -> str:
    """Return text that every database takes: NUL and surrogates, which come from other bytes, become escapes."""
    return _NOT_TO_STORE.sub(_escaped, text)


def storable_data(value: object) -> object:
    """Return plain data in which every text is `storable`; names of fields too."""
    if isinstance(value, str):
        return storable(value)
    if isinstance(value, Mapping):
        fields = cast("Mapping[object, object]", value)
        return {storable_data(name): storable_data(item) for name, item in fields.items()}
    if isinstance(value, list | tuple):
        return [storable_data(item) for item in cast("Sequence[object]", value)]
    return value


def _escaped(found: re.Match[str]) -> str:
    return ascii(found[0])[1:-1]


def _json_escaped(found: re.Match[str]) -> str:
    units = found[0].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))


SIMULATED = "SIMULATED: made by a simulated rig, not by a camera in front of a specimen"  # in every file with room


def counted(number: int, one: str, more: str = "") -> str:
    """Return a count as text: `1 deviation`, `2 deviations`, `no deviation`. `more` is an irregular plural."""
    return f"{number or 'no'} {one if number in (0, 1) else more or one + 's'}"


def time_utc(at_utc: str) -> str:
    """Return the time of day of a recorded time (ISO 8601): `20:41:07 UTC`."""
    return f"{at_utc[11:19]} UTC"


def local_time(at_utc: str) -> str:
    """Return a recorded time on the clock of this machine and its site: `10:12:03 CET`; "" where that is UTC."""
    try:
        there = datetime.fromisoformat(at_utc).astimezone()
    except ValueError:
        return ""
    if not there.utcoffset():
        return ""
    day = f"{there:%Y-%m-%d} " if f"{there:%Y-%m-%d}" != at_utc[:10] else ""
    return f"{day}{there:%H:%M:%S} {there.tzname()}"


def time_here(at_utc: str) -> str:
    """Return the time of day of a recorded time on the clock on the wall, and in UTC only where that is the same."""
    return local_time(at_utc) or time_utc(at_utc)
