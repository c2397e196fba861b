"""The filters of the lists of runs, events and files; the query of a page is one, and where in the list it begins."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict

LONGEST = 200  # characters of a field; more is cut
_PLACE = {"page", "after", "before"}  # where in the list a page begins is no part of the filter


def cut(text: str) -> str:
    """Return the text of a field, cut to the longest length and without NUL."""
    return text[:LONGEST].replace("\0", "")


Text = Annotated[str, AfterValidator(cut)]
Ticked = Annotated[bool, BeforeValidator(bool)]  # any text ticks the box


class Filter(BaseModel):
    """Base of filters; an empty field matches all."""

    model_config = ConfigDict(frozen=True)

    @property
    def active(self) -> bool:
        """True if any field is set."""
        return bool(self.query())

    def query(self) -> dict[str, str]:
        """Return the filter as query parameters of a link."""
        fields = self.model_dump(exclude=_PLACE)
        return {name: "1" if value is True else value for name, value in fields.items() if value}


class EventFilter(Filter):
    """A filter for events."""

    step: Text = ""
    device: Text = ""
    person: Text = ""
    kind: Text = ""
    q: Text = ""


class ArtefactFilter(Filter):
    """A filter for files."""

    kind: Text = ""
    step: Text = ""
    device: Text = ""
    viewpoint: Text = ""
    q: Text = ""


class RunFilter(Filter):
    """A filter for runs, in the audit."""

    since: Text = ""  # 2026-11-21
    until: Text = ""
    protocol: Text = ""
    person: Text = ""
    status: Text = ""
    simulated: Text = ""  # yes, no
    q: Text = ""
    deviations: Ticked = False  # only runs with deviations
    unverified: Ticked = False  # only runs whose last verification is missing, outdated or found faults


Result = Literal["open", "completed", "aborted", "within", "outside", "released"]
RESULTS: tuple[Result, ...] = get_args(Result)


class RunSearch(Filter):
    """A search for runs by what people wrote about them, by day and by result."""

    q: str = ""  # words that must all occur in what people wrote about the run
    since: str = ""  # 2026-11-21, in UTC
    until: str = ""
    result: Annotated[str, AfterValidator(lambda result: result if result in RESULTS else "")] = ""

    @property
    def active(self) -> bool:
        """True if any field is set; blanks are no words to search for."""
        return any((self.q.strip(), self.since, self.until, self.result))
