"""What the auditor's pages are asked for: the fields of their addresses, cut to a length that a page can show."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator

from service.audit.overview.first_page import RunFilter
from service.audit.record.artefact_queries import ArtefactFilter
from service.audit.record.queries import EventFilter

LONGEST = 200  # characters of a filter; more is cut


def cut(text: str) -> str:
    """A filter as it is used and shown."""
    return text[:LONGEST].replace("\0", "")


Text = Annotated[str, AfterValidator(cut)]
Ticked = Annotated[bool, BeforeValidator(bool)]  # any text ticks the box


class RunQuery(BaseModel):
    """Of the list of runs."""

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
        """Which runs."""
        return RunFilter(**self.model_dump(exclude={"page"}))


class EventQuery(BaseModel):
    """Of a list of events, which goes on after one event or ends before one."""

    step: Text = ""
    device: Text = ""
    person: Text = ""
    kind: Text = ""
    q: Text = ""
    after: int = 0
    before: int = 0

    def wanted(self) -> EventFilter:
        """Which events."""
        return EventFilter(self.step, self.device, self.person, self.kind, self.q)


class ArtefactQuery(BaseModel):
    """Of the list of files."""

    kind: Text = ""
    step: Text = ""
    device: Text = ""
    viewpoint: Text = ""
    q: Text = ""
    page: int = 1

    def wanted(self) -> ArtefactFilter:
        """Which files."""
        return ArtefactFilter(self.kind, self.step, self.device, self.viewpoint, self.q)
