"""What people enter in their own words: what a run is for, and notes on its steps. Bounded, and plain text."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from service.core.errors import ConfigurationError
from service.core.records.base import ArtefactRef, Record

LINE_CHARACTERS = 200
TEXT_CHARACTERS = 4000
_Line = Annotated[str, Field(max_length=LINE_CHARACTERS)]
_Text = Annotated[str, Field(max_length=TEXT_CHARACTERS)]


class RunAbout(Record):
    """What a run is of and for, as it was entered when it began; "" for what was not."""

    specimen: _Line = ""
    purpose: _Line = ""
    site: _Line = ""
    operator: _Line = ""  # who works at the rig; who began the run, by account, is in its root
    text: _Text = ""


class NoteTaken(Record):
    """Somebody wrote something down on a step, took a photograph of it, or both. It has no effect on the run."""

    kind: Literal["note_taken"] = "note_taken"
    step: str
    attempt: int
    text: _Text = ""
    photograph: ArtefactRef | None = None
    via: Literal["web", "cli"]


# Field → what people call it, in the order in which it is shown.
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
    """What was entered, put in order. Raises ConfigurationError, naming the field, for what is too long."""
    return RunAbout(
        specimen=line(specimen, "the specimen"),
        purpose=line(purpose, "the purpose"),
        site=line(site, "the site"),
        operator=line(operator, "the operator"),
        text=paragraphs(text, "the remarks"),
    )


def about_rows(about: RunAbout | None) -> list[tuple[str, str]]:
    """Name and text of each field that was filled in; empty for runs that were recorded without."""
    if about is None:
        return []
    return [(name, value) for field, name in ABOUT.items() if (value := str(getattr(about, field)))]


def line(entered: str, what: str) -> str:
    """One line without control characters. Raises ConfigurationError where it is longer than LINE_CHARACTERS."""
    return _bounded(" ".join(_plain(entered).split()), what, LINE_CHARACTERS)


def paragraphs(entered: str, what: str) -> str:
    """Lines without control characters. Raises ConfigurationError beyond TEXT_CHARACTERS."""
    lines = (" ".join(each.split()) for each in _plain(entered).split("\n"))
    return _bounded("\n".join(lines).strip(), what, TEXT_CHARACTERS)


def _plain(entered: str) -> str:
    # Neither controls (a terminal would obey them) nor halves of characters, which have no canonical form.
    lines = entered.replace("\r\n", "\n").replace("\r", "\n")
    return "".join(c if c == "\n" or unicodedata.category(c) not in ("Cc", "Cs") else " " for c in lines)


def _bounded(text: str, what: str, most: int) -> str:
    if len(text) > most:
        raise ConfigurationError(
            f"{what} has {len(text)} characters, and {most} at most are recorded",
            remedy="Say it in fewer words",
        )
    return text
