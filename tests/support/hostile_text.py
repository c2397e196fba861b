"""Texts from outside that mean harm to a terminal, to markup, to a page, or to a database."""

from __future__ import annotations

import re

HOSTILE = {
    "style in brackets": "[bold red]x[/]",
    "brackets that close nothing": "a [/nothing] b",
    "link in brackets": "[link=https://example.org]x[/link]",
    "name of an emoji": ":warning: and :skull:",
    "rows above erased": "eve\x1b[3A\x1b[2K\x1b[1;1H",
    "title of the window": "\x1b]0;owned\x07x",
    "eight-bit escape": "\x9b31mx",
    "line written over": "eve\rVerified",
    "line of its own": "x\nVerified: everything is as it was recorded.",
    "letters taken back": "eve\b\b\bada",
    "direction turned": "\u202egnp.exe\u202c",
    "isolated direction": "\u2067x\u2069",
    "line separator": "x\u2028Verified",
    "no width": "a\u200bda",
    "NUL": "a\x00b",
    "surrogate": "a\udcffb",
    "pair of surrogates": "\ud83d\ude00",
    "tags": "x\U000e0041\U000e0042",
    "tabs": "a\tb",
    "deleted": "a\x7fb",
    "element of a page": "<img src=x onerror=alert(1)>",
    "end of an attribute": "x\"' onmouseover=alert(1) '\"",
}

# All of them that a shell can give to a command, in one line; and those that a database may refuse.
TYPED = " ".join(text for text in HOSTILE.values() if "\x00" not in text)
UNSTORABLE = {name: HOSTILE[name] for name in ("NUL", "surrogate", "pair of surrogates")} | {
    "all of them": " ".join(HOSTILE.values())
}

_OBEYED = re.compile(
    r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b\u200e\u200f\u2028-\u202e\u2066-\u2069]|[\ud800-\udfff\U000e0000-\U000e007f]"
)


def obeyed(printed: str) -> list[str]:
    """What a terminal would obey in a text that was printed without colours; line breaks are ours."""
    return _OBEYED.findall(printed)
