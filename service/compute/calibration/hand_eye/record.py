"""Converts board views to a hand-eye calibration's input and its result to plain data (hand_eye.json, evidence)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from service.compute.arm.correction import ArmCorrection, corrected_T_base_flange
from service.compute.calibration.board.board import Board, BoardView
from service.compute.calibration.hand_eye.answers import HandEyeAnswer, HandEyeResult
from service.compute.calibration.hand_eye.closed_form import distance
from service.compute.calibration.hand_eye.reprojection import BoardCorners
from service.compute.calibration.hand_eye.setup import Setup
from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.units import deg, mm

_BESIDE = {"T_flange_camera": "T_base_camera", "T_base_board": "T_flange_board"}


def hand_eye_record(result: HandEyeResult, images: Sequence[str], setup: Setup = "eye-in-hand") -> dict[str, Any]:
    """The result as plain data: transforms (4×4) and covariances in metres and radians, errors in mm and degrees.

    For a camera beside the robot (eye-to-hand) the record holds T_base_camera and T_flange_board instead, so that
    nothing that expects T_flange_camera can read it by mistake.

    `T_flange_camera` is for poses as the robot reports them. `arm_correction`, if not null, holds the correction of
    the poses and the T_flange_camera for corrected poses (`read_arm_correction`).
    """
    chosen = result.T_flange_camera
    corrected = result.corrected
    record: dict[str, Any] = {
        **_answer(result, images),
        "setup": setup,
        "method": result.method,
        "methods": {
            name: {
                "T_flange_camera": T.tolist(),
                "distance_mm": distance(T, chosen)[0],
                "distance_deg": distance(T, chosen)[1],
            }
            for name, T in result.methods.items()
        },
        "spread": {"mm": result.spread_mm, "deg": result.spread_deg},
        "corner_sigma_px": result.corner_sigma_px,
        "motion": {
            "rotation_spread_deg": result.rotation_spread_deg,
            "second_axis_deg": result.second_axis_deg,
            "condition": result.condition,
        },
        "excluded": {images[i]: reason for i, reason in result.excluded.items()},
        "turned": [name for name, turned in zip(images, result.turned, strict=True) if turned],
        "arm_held_out_rms_mm": dict(result.arm_held_out_mm),
        "arm_correction": None
        if corrected is None
        else {**corrected.correction.as_json(), **_answer(corrected, images), "terms": corrected.terms},
    }
    return record if setup == "eye-in-hand" else _renamed(record)


def _renamed(record: Mapping[str, Any]) -> dict[str, Any]:
    return {
        _BESIDE.get(key, key): _renamed(cast("dict[str, Any]", value)) if isinstance(value, dict) else value
        for key, value in record.items()
    }


def _answer(answer: HandEyeAnswer, images: Sequence[str]) -> dict[str, Any]:
    formal = answer.formal_covariance
    return {
        "T_flange_camera": answer.T_flange_camera.tolist(),
        "T_base_board": answer.T_base_board.tolist(),
        "sigma": {
            "mm": answer.sigma_mm,
            "deg": answer.sigma_deg,
            "covariance": answer.covariance.tolist(),
            "camera_mm": mm(float(np.sqrt(np.trace(answer.camera_share[:3, :3])))),
            "camera_deg": deg(np.sqrt(np.trace(answer.camera_share[3:, 3:]))),
            "formal_covariance": None if formal is None else formal.tolist(),
        },
        "robot_noise": {"mm": answer.robot_noise_mm, "deg": answer.robot_noise_deg},
        "residuals": {
            key: {name: float(v) for name, v in zip(images, values, strict=True)}
            for key, values in (
                ("mm", answer.residual_mm),
                ("deg", answer.residual_deg),
                ("held_out_mm", answer.held_out_mm),
                ("held_out_deg", answer.held_out_deg),
            )
        },
    }


def board_corners(views: Sequence[BoardView], board: Board, camera: CameraModel) -> BoardCorners:
    """Views of a board, possibly partial, in the form that `calibrate_hand_eye` takes."""
    points = board.points()
    pixels = np.full((len(views), len(points), 2), np.nan)
    for row, view in zip(pixels, views, strict=True):
        row[view.indices] = view.corners
    return BoardCorners(points, pixels, camera)


@dataclass(frozen=True, slots=True)
class ArmCorrected:
    """Converts an arm's joints and reported poses to camera poses."""

    correction: ArmCorrection
    T_flange_camera: Transform

    def T_base_camera(self, joints_rad: Array, T_base_flange: Array) -> Array:
        """(N, 4, 4) camera poses from joints (N, J) and reported poses (N, 4, 4).

        Raises:
            DataError: joints and poses of another arm.
        """
        return corrected_T_base_flange(joints_rad, T_base_flange, self.correction) @ self.T_flange_camera


def read_arm_correction(record: Mapping[str, Any]) -> ArmCorrected:
    """Read the value of `arm_correction` from a record; it must not be null.

    Raises:
        DataError: a field is missing or has another shape.
    """
    missing = DataError(
        "an arm correction without T_flange_camera (4 × 4)",
        where="arm_correction of the hand-eye calibration",
        remedy="Calibrate hand and eye again",
    )
    try:
        T_flange_camera = np.array(record.get("T_flange_camera"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise missing from error
    if T_flange_camera.shape != (4, 4):
        raise missing
    return ArmCorrected(ArmCorrection.from_json(record), T_flange_camera)
