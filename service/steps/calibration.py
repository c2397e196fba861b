"""Step kind `calibration`: board images from the robot give the intrinsics and the hand-eye transform."""

from __future__ import annotations

from typing import Any, Literal

from service.core.errors import ConfigurationError
from service.core.model import Record
from service.steps.capture import capture_viewpoints
from service.steps.context import JobRequest, StepContext, StepKind, StepOutcome
from service.steps.inputs import captured_images, result_of
from service.steps.optics import departing_images, optics_departures
from service.steps.viewpoints import ViewpointSet, plan_viewpoints


class Params(Record):
    """Which board images, and what is computed from them."""

    solve: tuple[Literal["intrinsics", "hand_eye"], ...]
    viewpoints: tuple[ViewpointSet, ...] = ()
    images_of: str | None = None  # use the images of this earlier calibration step instead of new ones
    intrinsics_of: str | None = None  # hand-eye alone: the step that solved the intrinsics


class Result(Record):
    """The camera and, where solved, where it sits on the flange (4×4, metres)."""

    camera: dict[str, float]
    T_flange_camera: tuple[tuple[float, ...], ...] | None = None
    T_base_board: tuple[tuple[float, ...], ...] | None = None
    hand_eye: dict[str, Any] | None = None  # the whole record: covariance, residuals, methods, the arm's correction
    robots: tuple[str, ...] = ()  # devices whose flange carried the camera
    details: dict[str, object]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Capture the board, then let the worker solve."""
    measures: dict[str, float] = {}
    source = params.images_of or context.step.id
    if params.images_of is None:
        plan = [
            viewpoint
            for viewpoint_set in params.viewpoints
            for viewpoint in plan_viewpoints(viewpoint_set, context.devices.layout(viewpoint_set.station))
        ]
        nominal = context.devices.nominal_T_flange_camera()
        measures |= capture_viewpoints(context, plan, nominal, image_kind="board_image").measures()
        departures = optics_departures(context)
        if departures is not None:
            measures["optics_departures"] = float(departing_images(departures))
    camera = None
    if "intrinsics" not in params.solve:
        if params.intrinsics_of is None:
            raise ConfigurationError(
                "hand-eye needs intrinsics", where=f"step {context.step.id}", remedy="Name the step in intrinsics_of"
            )
        camera = result_of(context, params.intrinsics_of)["camera"]
    board = context.protocol.board
    if board is None:
        raise ConfigurationError(
            "the protocol describes no calibration board", where=context.protocol.id, remedy="Add a section `board`"
        )
    images = captured_images(context, [source])
    (answer,) = context.evidence.run_jobs(
        JobRequest(
            "calibrate",
            {
                "solve": list(params.solve),
                "images": images,
                "columns": board.columns,
                "rows": board.rows,
                "square_m": board.square_mm / 1000,
                "camera": camera,
            },
        )
    )
    robots = {context.devices.layout(image["station"]).robot for image in images if image["station"]}
    result = Result.model_validate({**answer.result, "robots": sorted(robots)})
    return StepOutcome({**measures, **answer.measures}, answer.artefacts, result.model_dump(mode="json"))


KIND = StepKind("calibration", Params, Result, execute, moves_robot=True)
