"""Step kind `viewpoint_capture`: the robot carries the camera to the protocol's viewpoints of one station."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Annotated, Literal

from service.compute.planning.motion_plan import Order
from service.core.protocol.models import MovingParams
from service.core.records.events import Record
from service.steps.capture.live_numbers import Live, LiveAnalysis
from service.steps.capture.optics import departing_images, optics_departures
from service.steps.capture.plan.planning import feasible_extra, plan_step
from service.steps.capture.plan.viewpoints import Viewpoint, ViewpointSet, denser_viewpoints, plan_viewpoints
from service.steps.capture.retakes import advise_retakes, to_take_again
from service.steps.capture.views import CaptureTotals, capture_viewpoints
from service.steps.context import ROBOT_MOVES, Announcement, StepContext, StepKind, StepOutcome
from service.steps.measures import CaptureMeasures, Count, ErrorMm, PredictedMeasures
from service.steps.poses.front_end import EarlyFeatures


class Params(MovingParams):
    """Which viewpoints, what the images are for, and what is to be known of them while they are taken."""

    purpose: Literal["dataset", "control"]  # what the images are for
    viewpoints: tuple[ViewpointSet, ...]  # from where
    order: Order = "as_listed"  # as listed, or the shortest way
    live: Live | None = None  # what is computed of each image while the capture goes on; without it nothing


class Measures(PredictedMeasures, CaptureMeasures):
    """Of the capture, and of what its images are predicted to give."""

    images_spoilt: Annotated[
        Count, "images that are black, blurred or overexposed, and were so again when they were repeated"
    ] = None
    live_images: Annotated[Count, "images that the prediction takes into account"] = None
    outline_limited_error_mm: Annotated[
        ErrorMm, "`predicted_target_error_mm` if the camera poses were exact: only the outlines limit it"
    ] = None


class Result(Record):
    """What was captured; the images themselves are in the viewpoint events."""

    purpose: str
    captured: int


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Capture every viewpoint set of this step, and the viewpoints that an earlier attempt found wanting."""
    plan = [
        viewpoint
        for viewpoint_set in params.viewpoints
        for viewpoint in plan_viewpoints(viewpoint_set, context.devices.layout(viewpoint_set.station))
    ]
    live = LiveAnalysis.begin(context, params.live)
    last = params.viewpoints[-1]
    extra = denser_viewpoints(last, context.devices.layout(last.station))
    if live is not None:
        wanted = live.suggested()
        plan += [viewpoint for viewpoint in extra if viewpoint.name in wanted]
    context.devices.camera()  # no plan for an arm whose camera does not answer
    nominal = context.devices.nominal_T_flange_camera()
    there = {capture.viewpoint for capture in context.evidence.captures(context.step.id)}
    planned = plan_step(context, [v for v in plan if v.name not in there], nominal, params.order)
    features = EarlyFeatures.begin(context, plan)

    def look() -> None:
        for begun in (live, features):
            if begun is not None:
                begun.look()

    def take(viewpoints: Sequence[Viewpoint], again: Collection[str]) -> CaptureTotals:
        return capture_viewpoints(
            context,
            viewpoints,
            nominal,
            image_kind="image" if params.purpose == "dataset" else "control_image",
            refused=planned.refused,
            on_captured=look,
            until=lambda: live is not None and bool(live.spoilt_in_a_row()),
            again=again,
        )

    everything = [*planned.viewpoints, *(v for v in plan if v.name in there)]
    totals = take(everything, to_take_again(context))
    measures: dict[str, float] = {}
    spoilt: dict[str, str] = {}
    if live is not None:
        spoilt = live.spoilt()
        if spoilt:
            for capture in context.evidence.captures(context.step.id):
                why = spoilt.get(capture.artefacts[0].sha256)
                if why is not None:
                    context.tell(f"{capture.viewpoint}: {why}; it is taken again")
            totals = replace(
                take(_of_images(context, everything, spoilt), spoilt),
                planned=totals.planned,
                given_up=totals.given_up,
            )
            spoilt = live.spoilt()
        live.note_spoilt(spoilt)
        measures["images_spoilt"] = float(len(spoilt))
    measures |= totals.measures()
    departures = optics_departures(context)
    if departures is not None:
        measures["optics_departures"] = float(departing_images(departures))
    departing = {departure.image for departure in departures or ()}
    refused = {c.viewpoint for c in context.evidence.captures(context.step.id) if not all(c.verdicts.values())}
    bad = departing | refused | {v.name for v in _of_images(context, everything, spoilt)}
    again = len(bad) + totals.given_up
    retakes = advise_retakes(context, measures, again)
    if live is not None:
        taken = {viewpoint.name for viewpoint in plan}
        candidates = feasible_extra(context, [v for v in extra if v.name not in taken], nominal)
        measures |= live.summary(last.station, candidates, retakes, again if retakes else 0)
    result = Result(purpose=params.purpose, captured=totals.captured)
    return StepOutcome(Measures.read(measures), result=result.model_dump())


def _of_images(context: StepContext, viewpoints: Sequence[Viewpoint], images: Collection[str]) -> list[Viewpoint]:
    """The viewpoints at which these images (SHA-256) were taken."""
    taken = {c.viewpoint for c in context.evidence.captures(context.step.id) if c.artefacts[0].sha256 in images}
    return [viewpoint for viewpoint in viewpoints if viewpoint.name in taken]


KIND = StepKind(
    "viewpoint_capture",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, before: Announcement(f"the robot takes {before.images()}{before.at_stations}", ROBOT_MOVES),
    drawing="stations",
)
