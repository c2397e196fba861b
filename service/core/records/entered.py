"""Free text that people enter: what a run is for, and notes on its steps. Plain text of bounded length."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from service.core.errors import ConfigurationError
from service.core.records.base import ArtefactRef, Record
from service.core.text.person_names import person_name

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
