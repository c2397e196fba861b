"""Step kind `checklist`: manual work that the software can only ask about (fixation, hand-over, removal)."""

from __future__ import annotations

from typing import Annotated, ClassVar

from service.core.records.base import Record
from service.core.step_params import RepeatedStep, StepParams
from service.steps.context import Announcement, StepContext, StepKind, StepOutcome
from service.steps.measures import Count, MeasureRecord


class Params(StepParams):
    """No parameters: the items are in the step's checklist."""

    only_ticks: ClassVar = True
    repeated: ClassVar = RepeatedStep("Do the open items, tick them, and confirm again", device=False, computes=False)
    needs_disk: ClassVar = False


class Measures(MeasureRecord):
    """The items that the operator ticked when confirming, and those left open."""

    checklist_items_open: Annotated[Count, "items that are not ticked"] = None
    checklist_items_ticked: Annotated[Count, "items that are ticked"] = None


class Result(Record):
    """The number of items that were ticked."""

    items: int
    ticked: int


def execute(context: StepContext, _params: Params) -> StepOutcome:
    """Count the items that the operator ticked; the confirmation itself is an event."""
    items = len(context.step.checklist)
    ticked = len(context.state.ticked)
    result = Result(items=items, ticked=ticked)
    measures = Measures(checklist_items_ticked=float(ticked), checklist_items_open=float(items - ticked))
    return StepOutcome(measures, result=result)


KIND = StepKind(
    "checklist",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, _before: Announcement("all of this is done"),
)
