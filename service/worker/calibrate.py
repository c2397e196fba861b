"""Job `calibrate`: board images → intrinsics, hand-eye, or both."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from service.compute.calibration.board import Board
from service.compute.calibration.board_images import UsableViews, find_boards, usable_views
from service.compute.calibration.hand_eye import calibrate_hand_eye
from service.compute.calibration.intrinsics import calibrate_intrinsics, locate_view
from service.compute.calibration.intrinsics_record import intrinsics_record
from service.compute.calibration.uncertainty import board_distance_m, projection_uncertainty
from service.compute.calibration.validation import MIN_VIEWS_TO_VALIDATE, calibration_warnings, cross_validate
from service.compute.camera_model import CameraModel
from service.worker.job import JobAnswer, JobContext


def calibrate(context: JobContext) -> JobAnswer:
    """Detect the board in every image, then solve what the step asks for."""
    arguments = context.arguments
    images = arguments["images"]
    names = [image["viewpoint"] for image in images]
    board = Board(int(arguments["columns"]), int(arguments["rows"]), float(arguments["square_m"]))
    found = find_boards(
        [context.input(image["sha256"]) for image in images],
        board,
        workers=os.cpu_count() or 1,
        progress=lambda done, total: context.progress("board images", done, total),
    )
    usable = usable_views(found)
    seen = usable.indices
    missed = [names[k] for k in usable.excluded]
    measures: dict[str, float] = {"views": float(len(seen)), "views_without_board": float(len(missed))}
    details: dict[str, Any] = {"views_without_board": missed}
    if "intrinsics" in arguments["solve"]:
        camera, intrinsics_measures, details["intrinsics"] = _intrinsics(usable, board, names)
        measures |= intrinsics_measures
    else:
        camera = context.camera()
    result: dict[str, Any] = {"camera": camera.record(), "details": details}
    if "hand_eye" in arguments["solve"]:
        T_camera_board = np.array([locate_view(view, board, camera)[0] for view in usable.views])
        T_base_flange = np.array([images[i]["T_base_flange"] for i in seen])
        answer = calibrate_hand_eye(T_base_flange, T_camera_board, T_board_turned=board.half_turn())
        result["T_flange_camera"] = answer.T_flange_camera.tolist()
        result["T_base_board"] = answer.T_base_board.tolist()
        measures |= {
            "hand_eye_sigma_mm": answer.sigma_mm,
            "hand_eye_sigma_deg": answer.sigma_deg,
            "hand_eye_held_out_mm": float(np.median(answer.held_out_mm)),
            "hand_eye_held_out_deg": float(np.median(answer.held_out_deg)),
            "rotation_spread_deg": answer.rotation_spread_deg,
        }
        details["hand_eye_methods_spread_mm"] = answer.spread_mm
    ref = context.keep_json({**result, "measures": measures}, kind="calibration", name="calibration.json")
    return JobAnswer(measures, (ref,), result)


def _intrinsics(
    usable: UsableViews, board: Board, names: Sequence[str]
) -> tuple[CameraModel, dict[str, float], dict[str, Any]]:
    """The camera, measures for gates, and all that is known of the calibration (`intrinsics_record`)."""
    solved = calibrate_intrinsics(usable.views, board, usable.size)
    validation = cross_validate(solved) if len(solved.views) >= MIN_VIEWS_TO_VALIDATE else None
    uncertainty = projection_uncertainty(solved, board_distance_m(solved))
    excluded = dict(usable.excluded) | {usable.indices[view.index]: view.reason for view in solved.excluded}
    record = intrinsics_record(
        solved,
        validation,
        uncertainty,
        calibration_warnings(solved, validation, uncertainty),
        [names[usable.indices[k]] for k in solved.views],
        {names[k]: excluded[k] for k in sorted(excluded)},
    )
    measures = {
        "views": float(len(solved.views)),
        "views_excluded": float(len(solved.excluded)),
        "rms_px": solved.rms_px,
        "coverage": solved.coverage,
        "tilt_deg": float(solved.tilt_deg.max()),
        "uncertainty_px": uncertainty.worst_px,
        "uncertainty_mm": uncertainty.worst_mm,
        "uncertainty_centre_mm": uncertainty.centre_mm,
    }
    if validation is not None:
        measures["five_fold_rms_px"] = validation.five_fold_rms_px
        measures["leave_one_out_rms_px"] = validation.leave_one_out_rms_px
    return solved.camera, measures, record
