"""Step kind `timed_application`: a coating that is applied once and disappears, such as scanning spray."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar

from pydantic import BaseModel

from service.core.records.base import Moment, Record
from service.core.run.state import Note
from service.core.step_params import RepeatedStep, StepParams
from service.steps.context import Announcement, StepContext, StepKind, StepOutcome
from service.steps.measures import Count, MeasureRecord


class Params(StepParams):
    """The product that is applied, and how long it lasts."""

    repeated: ClassVar = RepeatedStep(
        "Judge it again as it is; the time since the coating runs on", same=True, device=False, computes=False
    )
    needs_disk: ClassVar = False

    product: str  # the product that is applied
    sublimates_after_s: float  # time until it has disappeared
    scan_within_s: float  # latest time of the scan after the application
    settle_s: float = 0.0  # waiting time before the next step


class Measures(MeasureRecord):
    """The fact that the product was applied."""

    applications: Annotated[Count, "times that the product was applied"] = None


class _Applied(BaseModel):
    """The note that the product was applied; notes on other things do not have the time."""

    applied_monotonic_s: float | None = None
    applied_utc: str = ""
    applied_boot: str = ""


class Result(Record):
    """The time of the coating, in both clocks of the host, and its limits."""

    product: str
    applied_monotonic_s: float
    applied_utc: str = ""  # ISO 8601; "" in a run of a version that stored the monotonic time alone
    applied_boot: str = ""  # boot id of the host, in which the monotonic time counts
    scan_within_s: float
    sublimates_after_s: float

    @property
    def applied(self) -> Moment:
        """The moment of the application."""
        return Moment(self.applied_monotonic_s, self.applied_utc, self.applied_boot)


def applied_at(notes: Sequence[Note]) -> Moment | None:
    """Return when the product was applied, by the notes of such a step; None if it was not yet."""
    for noted in notes:
        note = _Applied.model_validate(noted.data)
        if note.applied_monotonic_s is not None:
            return Moment(note.applied_monotonic_s, note.applied_utc or noted.at_utc, note.applied_boot)
    return None


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Start the timer at the operator's confirmation, and wait for the coating to settle."""
    earlier = applied_at(context.state.notes)
    applied = earlier or context.moment()
    if earlier is None:  # after a restart, the timer goes on
        context.note(
            f"{params.product} applied: scan within {params.scan_within_s / 60:.0f} min, "
            f"gone after {params.sublimates_after_s / 3600:.1f} h",
            applied_monotonic_s=applied.monotonic_s,
            applied_utc=applied.at_utc,
            applied_boot=applied.boot,
        )
    remaining = params.settle_s
    while remaining > 0:
        context.checkpoint()
        context.progress("letting the coat settle", int(params.settle_s - remaining), int(params.settle_s))
        context.wait(min(0.2, remaining))
        remaining -= 0.2
    result = Result(
        product=params.product,
        applied_monotonic_s=applied.monotonic_s,
        applied_utc=applied.at_utc,
        applied_boot=applied.boot,
        scan_within_s=params.scan_within_s,
        sublimates_after_s=params.sublimates_after_s,
    )
    return StepOutcome(Measures(applications=1.0), result=result)


KIND = StepKind(
    "timed_application",
    Params,
    Measures,
    Result,
    execute,
    words=lambda params, _before: Announcement(f"{params.product} is on, the clock starts"),
    drawing="spray",
)
