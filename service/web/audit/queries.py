"""Query fields of the auditor's pages, cut to a length that a page can show."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator

from service.audit.overview.first_page import RunFilter
from service.audit.record.search import ArtefactFilter, EventFilter

LONGEST = 200  # characters of a filter; more is cut


def cut(text: str) -> str:
    """The text of a filter, without outer blanks and cut to the longest length."""
    return text[:LONGEST].replace("\0", "")


Text = Annotated[str, AfterValidator(cut)]
Ticked = Annotated[bool, BeforeValidator(bool)]  # any text ticks the box


class RunQuery(BaseModel):
    """Filters of the list of runs."""

    since: Text = ""
    until: Text = ""
    protocol: Text = ""
    person: Text = ""
    status: Text = ""
    simulated: Text = ""
    deviations: Ticked = False
    unverified: Ticked = False
    q: Text = ""
    page: int = 1

    def wanted(self) -> RunFilter:
        """The filter of runs that these fields describe."""
        return RunFilter(**self.model_dump(exclude={"page"}))


class EventQuery(BaseModel):
    """Filters of a list of events, which begins after one event or ends before one."""

    step: Text = ""
    device: Text = ""
    person: Text = ""
    kind: Text = ""
    q: Text = ""
    after: int = 0
    before: int = 0

    def wanted(self) -> EventFilter:
        """The filter of events that these fields describe."""
        return EventFilter(self.step, self.device, self.person, self.kind, self.q)


class ArtefactQuery(BaseModel):
    """Filters of the list of files."""

    kind: Text = ""
    step: Text = ""
    device: Text = ""
    viewpoint: Text = ""
    q: Text = ""
    page: int = 1

    def wanted(self) -> ArtefactFilter:
        """The filter of files that these fields describe."""
        return ArtefactFilter(self.kind, self.step, self.device, self.viewpoint, self.q)
