"""Step kind `calibration`: board images from the robot give the intrinsics and the hand-eye transform."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from service.computations.calibration import (
    CALIBRATE,
    CalibrateAnswer,
    CalibrateArguments,
    CalibrationDetails,
    HandEye,
    KnownBoard,
)
from service.computations.records import Camera, Matrix, matrix
from service.core.errors import ConfigurationError
from service.core.records.base import Record
from service.core.step_params import NAMES_CALIBRATION, NAMES_CAPTURE, MovingParams, NeededDevice, RepeatedStep
from service.core.units import metres
from service.steps.context import (
    ROBOT_MOVES,
    Announcement,
    EarlierAnswer,
    JobRequest,
    JobResult,
    StepContext,
    StepKind,
    StepOutcome,
)
from service.steps.measures import CaptureMeasures, Count, FineMm, Measure, Mm, Px, Share
from service.steps.registration import captured_images
from service.steps.retakes import departing_images, optics_departures
from service.steps.viewpoints import BoardPoses, ViewpointSet, plan_viewpoints

if TYPE_CHECKING:
    from service.compute.calibration.board import Board
    from service.compute.calibration.board_knowledge import BoardKnowledge
    from service.steps.board_capture import BoardCapture

_FEWEST_KNOWN = 3  # images of the whole board needed before images of a part of it are used


class Params(MovingParams):
    """The board images to take, and the calibrations to compute from them."""

    gives: ClassVar = "calibration"
    repeated: ClassVar = RepeatedStep("Take the board images that are missing and compute again; the others are kept")

    solve: tuple[Literal["intrinsics", "hand_eye"], ...]  # the calibrations to compute
    board_poses: BoardPoses | None = None  # images whose poses the software plans
    viewpoints: tuple[ViewpointSet, ...] = ()  # or images from these viewpoints
    # Use the images of this earlier calibration step instead of new ones.
    images_of: Annotated[str | None, NAMES_CAPTURE] = None
    # For hand-eye alone: the step that solved the intrinsics.
    intrinsics_of: Annotated[str | None, NAMES_CALIBRATION] = None

    @property
    def moves_robot(self) -> bool:
        """True if new images are taken."""
        return self.images_of is None

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A camera, if new images are taken."""
        return (NeededDevice("camera"),) if self.images_of is None else ()

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.board_poses is not None and (self.viewpoints or self.images_of is not None):
            raise ValueError("a calibration needs one of board_poses, viewpoints and images_of, not two")
        return self


class Measures(CaptureMeasures):
    """The measures of the board images, the intrinsics and the hand-eye transform."""

    views: Annotated[Count, "board images that were used"] = None
    views_without_board: Annotated[Count, "board images in which no board was found"] = None
    views_partial: Annotated[Count, "board images that show a part of the board"] = None
    views_excluded: Annotated[Count, "board images left out as outliers"] = None
    boards_unseen: Annotated[Count, "board images in which the first search found no board"] = None
    rms_px: Annotated[Px, "rms reprojection error"] = None
    five_fold_rms_px: Annotated[Px, "rms reprojection error of held-out views (five-fold cross-validation)"] = None
    leave_one_out_rms_px: Annotated[Px, "rms reprojection error of each view by the calibration without it"] = None
    corner_sigma_px: Annotated[Px, "noise of the corners, as estimated"] = None
    coverage: Annotated[Share, "share of the image area in which corners of the board were seen"] = None
    tilt_deg: Annotated[float | None, Measure("°", 0, 90), "largest tilt of the board against the image plane"] = None
    uncertainty_px: Annotated[Px, "standard deviation of a projected point, worst in the image"] = None
    uncertainty_mm: Annotated[
        float | None,
        Measure("mm", 1e-4, 10),
        "uncertainty of a projected point as a length at the distance of the board",
    ] = None
    uncertainty_centre_mm: Annotated[
        float | None,
        Measure("mm", 1e-4, 10),
        "uncertainty of a point projected to the centre of the image, as a length at the board",
    ] = None
    board_bow_mm: Annotated[float | None, Measure("mm", 0, 5), "the larger of the board's two bows"] = None
    hand_eye_sigma_mm: Annotated[
        float | None, Measure("mm", 1e-4, 20), "standard deviation of the camera's position on the flange"
    ] = None
    hand_eye_sigma_deg: Annotated[
        float | None, Measure("°", 1e-5, 10), "standard deviation of the camera's rotation on the flange"
    ] = None
    hand_eye_held_out_mm: Annotated[
        float | None, Measure("mm", 1e-3, 50), "median position error of views held out of the hand-eye calibration"
    ] = None
    hand_eye_held_out_deg: Annotated[
        float | None, Measure("°", 1e-4, 10), "median rotation error of views held out of the hand-eye calibration"
    ] = None
    hand_eye_uncorrected_held_out_mm: Annotated[
        float | None,
        Measure("mm", 1e-3, 50),
        "median position error of held-out views without the correction of the arm",
    ] = None
    hand_eye_arm_corrected: Annotated[
        Share, "1 if a correction of the arm was found that reduces the errors, else 0"
    ] = None
    hand_eye_excluded: Annotated[Count, "views left out of the hand-eye calibration as outliers"] = None
    hand_eye_methods_spread_mm: Annotated[Mm, "spread of the camera's position between independent methods"] = None
    hand_eye_condition: Annotated[float | None, Measure("", 1, 1e6), "condition number of the hand-eye equations"] = (
        None
    )
    hand_eye_board_size_percent: Annotated[
        float | None,
        Measure("%", -20, 20),
        "by how much the board is larger by the robot's lengths than it is stated to be",
    ] = None
    hand_eye_findings: Annotated[Count, "contradictions between robot and images, in words in the result"] = None
    rotation_spread_deg: Annotated[float | None, Measure("°", 0, 180), "largest rotation between two views"] = None
    robot_noise_mm: Annotated[FineMm, "standard deviation of the arm's remaining position error, along each axis"] = (
        None
    )
    robot_noise_deg: Annotated[
        float | None,
        Measure("°", 1e-5, 10),
        "standard deviation of the arm's remaining rotation error, about each axis",
    ] = None


class Result(Record):
    """The camera and, if solved, its pose on the flange (4×4, metres)."""

    camera: Camera
    T_flange_camera: Matrix | None = None
    T_base_board: Matrix | None = None
    hand_eye: HandEye | None = None  # covariance, residuals, methods, the arm's correction
    robots: tuple[str, ...] = ()  # robots that carried the camera
    details: CalibrationDetails


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Capture the board and let the worker solve; if a gate fails, plan the views that would make it pass."""
    # Here, not above: a process that only reads the protocol does without the numerics that this brings.
    from service.steps.board_capture import mend_calibration  # noqa: PLC0415

    board = board_of_protocol(context)
    camera = _camera(context, params)
    measures: dict[str, float] = {}
    capture = None
    if params.images_of is None:
        capture = _board_capture(context, params, board, camera)
        measures |= capture.take()
        departures = optics_departures(context)
        if departures is not None:
            measures["optics_departures"] = float(departing_images(departures))
    answer = _solve(context, params, board, camera, capture)
    images = captured_images(context, [params.images_of or context.step.id])
    robots = {context.devices.layout(image.station).robot for image in images if image.station}
    result = Result.model_validate({**answer.result, "robots": sorted(robots)})
    measures |= answer.measures
    if capture is not None:
        mend_calibration(context, capture, measures)
    return StepOutcome(Measures.read(measures), answer.artefacts, result, computed_by=(answer.source,))


def board_of_protocol(context: StepContext) -> Board:
    """Return the protocol's board. Raises ConfigurationError if it describes none."""
    from service.compute.calibration.board import Board  # noqa: PLC0415 - as above

    board = context.protocol.board
    if board is None:
        raise ConfigurationError(
            "the protocol describes no calibration board", where=context.protocol.id, remedy="Add a section `board`"
        )
    return Board(board.columns, board.rows, metres(board.square_mm))


def _camera(context: StepContext, params: Params) -> EarlierAnswer[CalibrateAnswer] | None:
    """Return the answer with the intrinsics of an earlier step, if this one does not solve them."""
    if "intrinsics" in params.solve:
        return None
    if params.intrinsics_of is None:
        raise ConfigurationError(
            "hand-eye needs intrinsics", where=f"step {context.step.id}", remedy="Name the step in intrinsics_of"
        )
    return context.earlier_answer(params.intrinsics_of, CALIBRATE)


def _board_capture(
    context: StepContext, params: Params, board: Board, camera: EarlierAnswer[CalibrateAnswer] | None
) -> BoardCapture:
    from service.steps.board_capture import BoardCapture  # noqa: PLC0415 - as above

    given = tuple(
        viewpoint
        for viewpoint_set in params.viewpoints
        for viewpoint in plan_viewpoints(viewpoint_set, context.devices.layout(viewpoint_set.station))
    )
    wanted = params.board_poses or _as_board_poses(params.viewpoints)
    known = None if camera is None else camera.answer.camera
    return BoardCapture(context, wanted, board, params.solve, given, known, params.intrinsics_of)


def _as_board_poses(sets: tuple[ViewpointSet, ...]) -> BoardPoses:
    """Return the planning parameters for replacements of listed viewpoints."""
    arcs = [arc for one in sets for arc in one.arcs]
    offset = sets[-1].aim_offset_m[2]
    return BoardPoses(
        station=sets[-1].station,
        prefix=sets[-1].prefix,
        count=max(4, sum(one.count for one in sets)),
        tilts_deg=tuple(sorted({arc.tilt_deg for arc in arcs})),
        distances_m=(float(np.median([arc.distance_m for arc in arcs])),),
        above_scene_m=offset,
    )


def _solve(
    context: StepContext,
    params: Params,
    board: Board,
    camera: EarlierAnswer[CalibrateAnswer] | None,
    capture: BoardCapture | None,
) -> JobResult:
    from service.steps.board_capture import board_arguments  # noqa: PLC0415 - as above

    images = captured_images(context, [params.images_of or context.step.id])
    looks = {} if capture is None else {look.capture.artefacts[0].sha256: look for look in capture.looks()}
    images = [image for image in images if image.sha256 not in looks or not looks[image.sha256].spoilt]
    arguments = CalibrateArguments(
        solve=params.solve,
        images=tuple(images),
        **board_arguments(board),
        camera=None if camera is None else camera.answer.camera,
    )
    arguments = arguments.model_copy(update=_stated_of_board(context, camera))
    references = {} if camera is None else {"camera": camera.reference("camera")}
    if capture is not None:
        corners = tuple(looks[image.sha256].corners_sha256 if image.sha256 in looks else None for image in images)
        known = capture.knowledge() if None in corners else None
        if known is not None and known.measured < _FEWEST_KNOWN:
            known = None
        more = {"corners": corners, "known": None if known is None else _known(known)}
        arguments = arguments.model_copy(update=more)
    (answer,) = context.evidence.run_jobs(JobRequest.of(CALIBRATE, arguments, references))
    return answer


def _stated_of_board(context: StepContext, camera: EarlierAnswer[CalibrateAnswer] | None) -> dict[str, Any]:
    """Return what the protocol and the camera's calibration say of the board, as far as they do."""
    board = context.protocol.board
    stated: dict[str, Any] = {}
    if board is not None and board.size_tolerance_percent is not None:
        stated["size_tolerance"] = board.size_tolerance_percent / 100
    if board is not None and board.flatness_mm is not None:
        stated["flatness_mm"] = board.flatness_mm
    solved = None if camera is None else camera.answer.details.intrinsics
    if solved is not None and solved.board is not None:
        stated["seen"] = solved.board
    return stated


def _known(knowledge: BoardKnowledge) -> KnownBoard:
    return KnownBoard(
        camera=Camera.model_validate(knowledge.camera.record()),
        T_flange_camera=matrix(knowledge.T_flange_camera),
        T_base_board=matrix(knowledge.T_base_board),
        spread=matrix(knowledge.spread),
        focal=knowledge.focal,
        centre=knowledge.centre,
        measured=knowledge.measured,
    )


KIND = StepKind(
    "calibration",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, before: Announcement(
        f"the robot takes {before.images(' of the board')}{before.at_stations}", ROBOT_MOVES
    ),
    drawing="board",
)
