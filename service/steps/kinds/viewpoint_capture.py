"""Step kind `viewpoint_capture`: the robot carries the camera to the protocol's viewpoints of one station."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated, ClassVar, Literal

from service.compute.planning.motion_plan import Order
from service.core.records.base import Record
from service.core.step_params import MovingParams, NeededDevice, RepeatedStep
from service.steps.context import ROBOT_MOVES, Announcement, StepContext, StepKind, StepOutcome
from service.steps.due_jobs import EarlyFeatures
from service.steps.live_numbers import LiveAnalysis, LiveParams
from service.steps.measures import CaptureMeasures, Count, ErrorMm, PredictedMeasures
from service.steps.motion import StepPlan, feasible_extra, plan_step
from service.steps.retakes import advise_retakes, departing_images, optics_departures, taken_for_good, to_take_again
from service.steps.viewpoints import Viewpoint, ViewpointSet, denser_viewpoints, plan_viewpoints
from service.steps.views import CaptureTask, CaptureTotals, capture_viewpoints


class Params(MovingParams):
    """The viewpoints, the purpose of the images, and the numbers computed from them during the capture."""

    repeated: ClassVar = RepeatedStep("Take the views that are missing or would help; the others are kept")

    purpose: Literal["dataset", "control"]  # the purpose of the images
    viewpoints: tuple[ViewpointSet, ...]  # the viewpoints from which the images are taken
    order: Order = "as_listed"  # the order of the viewpoints: as listed, or along the shortest way
    live: LiveParams | None = None  # the numbers computed from each image during the capture; nothing if left out

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A camera."""
        return (NeededDevice("camera"),)

    @property
    def photographs_specimen(self) -> bool:
        """True: the specimen, or the control spheres around it."""
        return True


class Measures(PredictedMeasures, CaptureMeasures):
    """The measures of the capture, and what its images are predicted to give."""

    images_spoilt: Annotated[
        Count, "images that are black, blurred or overexposed, and were so again when they were repeated"
    ] = None
    images_unexamined: Annotated[
        Count, "images whose analysis had not finished or failed, so that nobody knows whether they are spoilt"
    ] = None
    live_images: Annotated[Count, "images that the prediction takes into account"] = None
    outline_limited_error_mm: Annotated[
        ErrorMm, "predicted error at the specimen if the camera poses were exact: only the outlines limit it"
    ] = None


class Result(Record):
    """The purpose and number of the images; the images themselves are in the viewpoint events."""

    purpose: str
    captured: int


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Capture every viewpoint set of this step, and the viewpoints that an earlier attempt asked for."""
    again = to_take_again(context)
    capture = _Capture(context, params, again)
    totals = capture.take(capture.plan, again)
    measures: dict[str, float] = {}
    spoilt: Mapping[str, str] = {}
    if capture.live is not None:
        totals, spoilt = capture.repeat_spoilt(capture.live, totals)
        measures["images_spoilt"] = float(len(spoilt))
        measures["images_unexamined"] = float(len(capture.live.unexamined()))
    measures |= totals.measures()
    departures = optics_departures(context)
    if departures is not None:
        measures["optics_departures"] = float(departing_images(departures))
    departing = {departure.image for departure in departures or ()}
    refused = {c.viewpoint for c in context.evidence.captures(context.step.id) if not all(c.verdicts.values())}
    bad = departing | refused | {v.name for v in capture.of_images(spoilt)}
    again = len(bad) + totals.given_up
    retakes = advise_retakes(context, measures, again)
    if capture.live is not None:
        candidates = capture.candidates()
        measures |= capture.live.summary(capture.last.station, candidates, retakes, again if retakes else 0)
    result = Result(purpose=params.purpose, captured=totals.captured)
    return StepOutcome(Measures.read(measures), result=result)


class _Capture:
    """The viewpoints of one execution of the step, and what is computed while they are captured."""

    def __init__(self, context: StepContext, params: Params, again: Collection[str]) -> None:
        self._context, self._purpose = context, params.purpose
        self._order: Order = params.order
        plan = [
            viewpoint
            for viewpoint_set in params.viewpoints
            for viewpoint in plan_viewpoints(viewpoint_set, context.devices.layout(viewpoint_set.station))
        ]
        self.live = LiveAnalysis.begin(context, params.live)
        self.last = params.viewpoints[-1]
        if self.live is not None:
            wanted = self.live.suggested()
            plan += [viewpoint for viewpoint in self._extra if viewpoint.name in wanted]
        context.devices.camera()  # before planning: without a camera no plan is needed
        self._nominal = context.devices.nominal_T_flange_camera()
        done = taken_for_good(context.evidence.captures(context.step.id), again)
        self._features = EarlyFeatures.begin(context, plan)
        self.plan = self._plan([v for v in plan if v.name not in done])
        self.viewpoints = [*self.plan.viewpoints, *(v for v in plan if v.name in done)]

    @cached_property
    def _extra(self) -> tuple[Viewpoint, ...]:
        """Further viewpoints of the last set, which only the analysis of the images may ask for."""
        return denser_viewpoints(self.last, self._context.devices.layout(self.last.station))

    def _plan(self, viewpoints: Sequence[Viewpoint]) -> StepPlan:
        """Plan the motions from where the arms stand."""
        return plan_step(self._context, viewpoints, self._nominal, self._order)

    def take(self, plan: StepPlan, again: Collection[str]) -> CaptureTotals:
        """Capture the viewpoints of a plan, and those whose image a person discards meanwhile.

        `again`: images (SHA-256) that are to be taken again.
        """
        planned = {viewpoint.name for viewpoint in plan.viewpoints}
        task = CaptureTask(
            plan,
            [viewpoint for viewpoint in self.viewpoints if viewpoint.name not in planned],
            lambda viewpoints: plan_step(self._context, viewpoints, self._nominal, "as_listed"),
            self._nominal,
            image_kind="image" if self._purpose == "dataset" else "control_image",
            on_captured=self._look,
            stop=lambda: self.live is not None and bool(self.live.spoilt_in_a_row()),
            again=again,
            all_cameras=self._purpose == "dataset",
        )
        return capture_viewpoints(self._context, task)

    def repeat_spoilt(self, live: LiveAnalysis, totals: CaptureTotals) -> tuple[CaptureTotals, Mapping[str, str]]:
        """Take spoilt images again, once each; the new totals, and the reason of each image that is spoilt again.

        An image whose job ends only while others are taken again is taken again after them.
        """
        repeated: set[str] = set()
        while True:
            spoilt = live.spoilt()
            captures = self._context.evidence.captures(self._context.step.id)
            due = {
                capture.artefacts[0].sha256: capture.viewpoint
                for capture in captures
                if capture.artefacts[0].sha256 in spoilt and capture.viewpoint not in repeated
            }
            if not due:
                break
            for sha256, viewpoint in due.items():
                self._context.tell(f"{viewpoint}: {spoilt[sha256]}; it is taken again")
            repeated |= set(due.values())
            totals = replace(self.take(self._plan(self.of_images(due)), due), given_up=totals.given_up)
        live.note_spoilt(spoilt)
        return totals, spoilt

    def of_images(self, images: Collection[str]) -> list[Viewpoint]:
        """Return the viewpoints at which these images (SHA-256) were taken."""
        captures = self._context.evidence.captures(self._context.step.id)
        taken = {capture.viewpoint for capture in captures if capture.artefacts[0].sha256 in images}
        return [viewpoint for viewpoint in self.viewpoints if viewpoint.name in taken]

    def candidates(self) -> list[tuple[Viewpoint, float]]:
        """Return further viewpoints of the last station that the arm can reach, with the travel time (s)."""
        taken = {viewpoint.name for viewpoint in self.viewpoints}
        return feasible_extra(self._context, [v for v in self._extra if v.name not in taken], self._nominal)

    def _look(self) -> None:
        for analysis in (self.live, self._features):
            if analysis is not None:
                analysis.look()


KIND = StepKind(
    "viewpoint_capture",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, before: Announcement(f"the robot takes {before.images()}{before.at_stations}", ROBOT_MOVES),
    drawing="stations",
)
