"""Step kind `checklist`: work of hands that the software can only ask about (fixation, hand-over, removal)."""

from __future__ import annotations

from service.core.records.events import Record
from service.steps.context import Announcement, StepContext, StepKind, StepOutcome
from service.steps.measured import COUNT


class Params(Record):
    """Nothing to set: the step's checklist says it all."""


class Result(Record):
    """How many items were ticked."""

    items: int
    ticked: int


def execute(context: StepContext, _params: Params) -> StepOutcome:
    """Count what the operator ticked when confirming; the confirmation itself is an event."""
    items = len(context.step.checklist)
    ticked = len(context.state.ticked)
    result = Result(items=items, ticked=ticked)
    return StepOutcome(
        measures={"checklist_items_ticked": float(ticked), "checklist_items_open": float(items - ticked)},
        result=result.model_dump(),
    )


KIND = StepKind(
    "checklist",
    Params,
    Result,
    execute,
    measures={"checklist_items_open": COUNT, "checklist_items_ticked": COUNT},
    words=lambda _params, _before: Announcement("all of this is done"),
)
