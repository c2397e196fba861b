"""Step kind `viewpoint_capture`: the robot carries the camera to the protocol's viewpoints of one station."""

from __future__ import annotations

from typing import Literal

from service.core.model import Record
from service.steps.capture import capture_viewpoints
from service.steps.context import StepContext, StepKind, StepOutcome
from service.steps.viewpoints import ViewpointSet, plan_viewpoints


class Params(Record):
    """Which viewpoints, and what the images are for."""

    purpose: Literal["dataset", "control"]
    viewpoints: tuple[ViewpointSet, ...]


class Result(Record):
    """What was captured; the images themselves are in the viewpoint events."""

    purpose: str
    captured: int


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Capture every viewpoint set of this step."""
    plan = [
        viewpoint
        for viewpoint_set in params.viewpoints
        for viewpoint in plan_viewpoints(viewpoint_set, context.devices.layout(viewpoint_set.station))
    ]
    totals = capture_viewpoints(
        context,
        plan,
        context.devices.nominal_T_flange_camera(),
        image_kind="image" if params.purpose == "dataset" else "control_image",
    )
    result = Result(purpose=params.purpose, captured=totals.captured)
    return StepOutcome(measures=totals.measures(), result=result.model_dump())


KIND = StepKind("viewpoint_capture", Params, Result, execute)
