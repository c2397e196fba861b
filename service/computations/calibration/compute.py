"""Jobs of the calibration: the board in an image as soon as it arrives, and the calibration from all images."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from service.computations.calibration import (
    BoardViewAnswer,
    BoardViewArguments,
    CalibrateAnswer,
    CalibrateArguments,
    CalibrationDetails,
    Corners,
    HandEye,
    Intrinsics,
    KnownBoard,
)
from service.computations.conversion import camera_of, camera_record, hand_eye_record, intrinsics_record, seen_board
from service.computations.job import JobAnswer, JobContext
from service.computations.records import BoardSize, PosedPhotograph
from service.compute.arm_kinematics import matching_arm
from service.compute.calibration.board import Board, BoardView, find_board
from service.compute.calibration.board_knowledge import BoardKnowledge
from service.compute.calibration.board_search import BoardImage, UsableViews, find_boards, usable_views, with_parts
from service.compute.calibration.hand_eye import HandEyeResult, HandEyeViews, calibrate_hand_eye
from service.compute.calibration.intrinsics import IntrinsicsResult, calibrate_intrinsics, locate_view
from service.compute.calibration.intrinsics_adjustment import LensModel
from service.compute.calibration.intrinsics_quality import (
    MIN_VIEWS_TO_VALIDATE,
    CrossValidation,
    ProjectionUncertainty,
    board_distance_m,
    calibration_warnings,
    cross_validate,
    projection_uncertainty,
)
from service.compute.calibration.reprojection import board_corners
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import image_quality, read_grey
from service.core.errors import ComputeError, DataError
from service.core.units import metres

_WHITE = 245.0  # an image counts as white if nearly all grey levels exceed this


def board_of(size: BoardSize) -> Board:
    """Return the board of a job's arguments."""
    return Board(size.columns, size.rows, size.square_m)


def board_view(context: JobContext[BoardViewArguments]) -> JobAnswer:
    """Find the whole board in an image, or the reason why not; and measure the sharpness of the image."""
    image = context.arguments.image
    cv2.setNumThreads(1)  # the capture goes on in parallel
    grey = read_grey(context.input(image.sha256))
    size = (grey.shape[1], grey.shape[0])
    quality = image_quality(grey)
    measures = {} if np.isnan(quality.edge_px) else {"image_edge_px": quality.edge_px}

    def answer(reason: str = "") -> BoardViewAnswer:
        return BoardViewAnswer(
            viewpoint=image.viewpoint, size=size, seen=not reason, reason=reason, black=quality.black
        )

    try:
        view = find_board(grey, board_of(context.arguments))
    except ComputeError as error:
        bright = float(np.percentile(grey, 1)) > _WHITE
        reason = "the image is black" if quality.black else "the image is white" if bright else plain_reason(error)
        return JobAnswer(measures, (), answer(reason))
    corners = np.round(view.corners, 4).tolist()
    record = Corners(size=size, indices=view.indices.tolist(), corners=corners)
    ref = context.keep_json(record.plain(), kind="board_corners", name=f"{image.viewpoint}.corners.json")
    return JobAnswer(measures | {"corners": float(len(view.indices))}, (ref,), answer())


def plain_reason(error: ComputeError) -> str:
    """Return why no board was found, without the details of the search."""
    return error.what.partition(" (searched")[0]


def read_corners(record: Corners) -> BoardImage:
    """Return the board in an image, from the file of `board_view`."""
    indices, corners = np.array(record.indices, dtype=np.int64), np.array(record.corners, dtype=np.float64)
    return BoardImage(record.size, BoardView(indices, corners))


def calibrate(context: JobContext[CalibrateArguments]) -> JobAnswer:
    """Find the board in every image, then solve what is asked for."""
    arguments = context.arguments
    images = arguments.images
    names = [image.viewpoint for image in images]
    board = _board(arguments)
    found, parts = _boards(context, board)
    usable = usable_views(found)
    seen = usable.indices
    missed = [names[k] for k in usable.excluded]
    measures: dict[str, float] = {"views": float(len(seen)), "views_without_board": float(len(missed))}
    details = CalibrationDetails(views_without_board=tuple(missed))
    if arguments.known is not None:
        measures["views_partial"] = float(len(parts))
        details = CalibrationDetails(
            views_without_board=tuple(missed),
            partial_views={names[k]: count for k, count in parts.items()},
            reasons={names[k]: reason for k, reason in usable.excluded.items()},
        )
    if "intrinsics" in arguments.solve:
        calibrated = calibrate_camera(usable, board)
        camera, intrinsics = calibrated.result.camera, calibrated.record(names)
        board = seen_board(board, intrinsics.board)
        details = details.model_copy(update={"intrinsics": intrinsics})
        measures |= calibrated.measures()
        if intrinsics.board is not None and intrinsics.board.bow_mm is not None:
            measures["board_bow_mm"] = max(map(abs, intrinsics.board.bow_mm))
    elif arguments.camera is not None:
        camera = camera_of(arguments.camera)
    else:
        raise DataError("a hand-eye calibration alone needs the camera's intrinsics")
    answer = CalibrateAnswer(camera=camera_record(camera), details=details)
    if "hand_eye" in arguments.solve:
        hand_eye, hand_eye_measures = _hand_eye(images, usable, board, camera)
        answer = CalibrateAnswer(
            camera=answer.camera,
            details=details,
            T_flange_camera=hand_eye.T_flange_camera,
            T_base_board=hand_eye.T_base_board,
            hand_eye=hand_eye,
        )
        measures |= hand_eye_measures
    kept = {**answer.plain(), "measures": measures}
    ref = context.keep_json(kept, kind="calibration", name="calibration.json")
    return JobAnswer(measures, (ref,), answer)


def _boards(context: JobContext[CalibrateArguments], board: Board) -> tuple[tuple[BoardImage, ...], dict[int, int]]:
    """Find the board in every image of a job, and count the corners in images that show a part of it.

    Images that `board_view` has searched are not searched again. Parts of the board are used if camera, mount and
    board are known well enough (`known`).
    """
    arguments = context.arguments
    images = arguments.images
    looked = arguments.corners or [None] * len(images)
    search = [k for k, sha256 in enumerate(looked) if sha256 is None]
    files = [context.input(images[k].sha256) for k in search]
    searched = dict(
        zip(
            search,
            find_boards(
                files,
                board,
                workers=os.cpu_count() or 1,
                progress=lambda done, total: context.progress("board images", done, total),
            ),
            strict=True,
        )
    )
    found = tuple(
        searched[k] if sha256 is None else read_corners(Corners.model_validate(context.input_json(sha256)))
        for k, sha256 in enumerate(looked)
    )
    if arguments.known is None or board.pattern != "checkerboard":
        return found, {}
    known = _knowledge(arguments.known)
    greys = [
        read_grey(context.input(image.sha256)) if one.view is None and one.size != (0, 0) else None
        for image, one in zip(images, found, strict=True)
    ]
    flanges = np.array([image.T_base_flange for image in images])
    whole = with_parts(found, greys, board, known, flanges)
    parts = {
        k: len(now.view.indices)
        for k, (before, now) in enumerate(zip(found, whole, strict=True))
        if before.view is None and now.view is not None
    }
    return whole, parts


def _knowledge(known: KnownBoard) -> BoardKnowledge:
    return BoardKnowledge(
        camera_of(known.camera),
        np.array(known.T_flange_camera),
        np.array(known.T_base_board),
        np.array(known.spread),
        known.focal,
        known.centre,
        known.measured,
    )


def _board(arguments: CalibrateArguments) -> Board:
    """Return the board as the protocol describes it, and bent as the camera's calibration has seen it."""
    board = board_of(arguments)
    if arguments.size_tolerance is not None:
        board = replace(board, size_tolerance=arguments.size_tolerance)
    if arguments.flatness_mm is not None:
        board = replace(board, flatness_m=metres(arguments.flatness_mm))
    return seen_board(board, arguments.seen)


def _hand_eye(
    images: Sequence[PosedPhotograph], usable: UsableViews, board: Board, camera: CameraModel
) -> tuple[HandEye, dict[str, float]]:
    """Return the whole record of the hand-eye calibration, and measures."""
    used = [images[i] for i in usable.indices]
    T_base_flange = np.array([image.T_base_flange for image in used])
    T_camera_board = np.array([locate_view(view, board, camera)[0] for view in usable.views])
    joints = np.array([image.joints_rad for image in used], dtype=np.float64)
    arm = matching_arm(joints, T_base_flange) if joints.ndim == 2 else None
    solved = calibrate_hand_eye(
        HandEyeViews(
            T_base_flange,
            T_camera_board,
            corners=board_corners(usable.views, board, camera),
            joints_rad=None if arm is None else joints,
            arm=arm,
            board=board,
        ),
        T_board_turned=board.half_turn(),
    )
    return hand_eye_record(solved, [image.viewpoint for image in used]), _hand_eye_measures(solved)


def _hand_eye_measures(solved: HandEyeResult) -> dict[str, float]:
    best = solved if solved.corrected is None else solved.corrected
    measures = {
        # Of the result that the registration uses: with the arm's correction, if there is one.
        "hand_eye_sigma_mm": best.sigma_mm,
        "hand_eye_sigma_deg": best.sigma_deg,
        "hand_eye_held_out_mm": float(np.median(best.held_out_mm)),
        "hand_eye_held_out_deg": float(np.median(best.held_out_deg)),
        "hand_eye_uncorrected_held_out_mm": float(np.median(solved.held_out_mm)),
        "hand_eye_arm_corrected": float(solved.corrected is not None),
        "hand_eye_excluded": float(len(solved.excluded)),
        "hand_eye_methods_spread_mm": solved.spread_mm,
        "hand_eye_condition": solved.condition,
        "rotation_spread_deg": solved.rotation_spread_deg,
        "hand_eye_board_size_percent": 100 * (best.size.ratio - 1),
        "hand_eye_findings": float(len(solved.findings)),
    }
    if best.robot_noise_mm is not None and best.robot_noise_deg is not None:
        measures |= {"robot_noise_mm": best.robot_noise_mm, "robot_noise_deg": best.robot_noise_deg}
    if solved.corner_sigma_px is not None:
        measures["corner_sigma_px"] = solved.corner_sigma_px
    return measures


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """A camera that was calibrated from images of a board, and how far it is to be trusted.

    Attributes:
        result: the calibration.
        validation: its cross-validation; None if there are too few images.
        uncertainty: the uncertainty of a projected point.
        warnings: sentences on the images.
        used: the numbers of the images used, in the order of `result.views`.
        excluded: the reason, by number of an image that was not used.
    """

    result: IntrinsicsResult
    validation: CrossValidation | None
    uncertainty: ProjectionUncertainty
    warnings: tuple[str, ...]
    used: tuple[int, ...]
    excluded: Mapping[int, str]

    def record(
        self, names: Sequence[str], *, left_out: Mapping[str, str] | None = None, warnings: Sequence[str] = ()
    ) -> Intrinsics:
        """Return the whole record of the calibration.

        Args:
            names: the names of all images.
            left_out: the reason, by name of an image that was not even searched.
            warnings: further sentences.
        """
        return intrinsics_record(
            self.result,
            self.validation,
            self.uncertainty,
            [*self.warnings, *warnings],
            [names[k] for k in self.used],
            {**(left_out or {}), **{names[k]: self.excluded[k] for k in sorted(self.excluded)}},
        )

    def measures(self) -> dict[str, float]:
        """Return what was measured, by the names under which a run records it."""
        result, validation = self.result, self.validation
        measures = {
            "views": float(len(result.views)),
            "views_excluded": float(len(result.excluded)),
            "rms_px": result.rms_px,
            "coverage": result.coverage,
            "tilt_deg": float(result.tilt_deg.max()),
            "uncertainty_px": self.uncertainty.worst_px,
            "uncertainty_mm": self.uncertainty.worst_mm,
            "uncertainty_centre_mm": self.uncertainty.centre_mm,
        }
        if validation is not None:
            measures["five_fold_rms_px"] = validation.five_fold_rms_px
            measures["leave_one_out_rms_px"] = validation.leave_one_out_rms_px
        return measures


def calibrate_camera(
    usable: UsableViews, board: Board, *, model: LensModel = "opencv4", distance_m: float | None = None
) -> CalibratedCamera:
    """Calibrate a camera, validate it, and propagate its errors to the specimen.

    Args:
        usable: the views of the board.
        board: the board.
        model: the model of the lens.
        distance_m: the specimen's distance, for the uncertainty; None: the board's.

    Raises:
        DataError: a view's corners do not belong to this board.
        ComputeError: too few views, or tilts so similar that the focal length is undetermined.
    """
    result = calibrate_intrinsics(usable.views, board, usable.size, model=model)
    validation = cross_validate(result) if len(result.views) >= MIN_VIEWS_TO_VALIDATE else None
    uncertainty = projection_uncertainty(result, board_distance_m(result) if distance_m is None else distance_m)
    return CalibratedCamera(
        result,
        validation,
        uncertainty,
        calibration_warnings(result, validation, uncertainty),
        used=tuple(usable.indices[k] for k in map(int, result.views)),
        excluded=dict(usable.excluded) | {usable.indices[view.index]: view.reason for view in result.excluded},
    )
