"""Which board images to add: parts of the image without corners, and poses that improve the hand-eye calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from service.compute.arm_correction import corrected_T_base_flange
from service.compute.arm_kinematics import nearest_posture
from service.compute.board.board import Board
from service.compute.board.next_poses import SuggestedPose, suggest_board_poses
from service.compute.camera_model import CameraModel
from service.compute.hand_eye.estimate import HandEyeAnswer
from service.core.arms.model import known_arm
from service.core.errors import OrthocaptureError
from service.core.geometry import Array, Transform, inverse
from service.core.protocol.models import CalibrationBoard as BoardSection
from service.core.records.events import ViewpointCaptured
from service.core.units import deg, metres, mm
from service.jobs.calibration.records import ArmAnswer, HandEye
from service.jobs.records import Camera
from service.web.record.pictures import cached
from service.worker.calibration.records import corrected_mounting

POSES = 6
_USUAL_CORNER_PX = 0.1  # 1σ of a board corner, for records that do not state it
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "centre", "right")


@dataclass(frozen=True, slots=True)
class PoseAdvice:
    """A board pose worth taking, as the pose of the camera relative to the board.

    Attributes:
        tilt_deg: of the optical axis from the board's normal.
        azimuth_deg: from which side, in the board's plane.
        roll_deg: of the image about the optical axis, against the one nearest to upright.
        distance_m: to the board's middle.
        sigma_mm, sigma_deg: of the hand-eye transform once this and the earlier poses are taken, 1σ.
        flange_mm: position of the flange in the base frame.
    """

    tilt_deg: float
    azimuth_deg: float
    roll_deg: float
    distance_m: float
    sigma_mm: float
    sigma_deg: float
    flange_mm: tuple[float, float, float]


_KEPT = TypeAdapter(tuple[PoseAdvice, ...])


def empty_regions(corners: Sequence[Sequence[int]]) -> list[tuple[str, int, int]]:
    """The ninths of the image in which cells hold no corner, worst first: name, such cells, all cells."""
    grid = np.array(corners)
    out: list[tuple[str, int, int]] = []
    for r, rows in enumerate(np.array_split(np.arange(grid.shape[0]), 3)):
        for c, columns in enumerate(np.array_split(np.arange(grid.shape[1]), 3)):
            block = grid[np.ix_(rows, columns)]
            empty = int((block == 0).sum())
            if empty:
                out.append((f"{_ROWS[r]} {_COLUMNS[c]}", empty, block.size))
    return sorted(out, key=lambda region: -region[1] / region[2])


def advised_poses(
    hand_eye: HandEye,
    camera: Camera,
    captures: Sequence[ViewpointCaptured],
    board: BoardSection,
    arm: str,
    data: Path,
    key: str,
) -> tuple[PoseAdvice, ...]:
    """Suggested poses, computed once for a calibration and cached; none if the linearised problem has no solution.

    Args:
        hand_eye: the hand-eye calibration.
        camera: the calibrated camera.
        captures: the board images that it used.
        board: the calibration board.
        arm: model name; poses that it does not reach are left out, where its kinematics are known.
        data: the data folder, in which the result is cached.
        key: of the calibration, such as its file's hash.
    """

    def make() -> bytes:
        try:
            found = _advise(hand_eye, CameraModel.from_record(camera.plain()), captures, board, arm)
        except (OrthocaptureError, np.linalg.LinAlgError):
            found = ()
        return _KEPT.dump_json(found)

    return _KEPT.validate_json(cached(data, f"board poses {key}", ".json", make).read_bytes())


def _advise(
    hand_eye: HandEye,
    camera: CameraModel,
    captures: Sequence[ViewpointCaptured],
    board: BoardSection,
    arm: str,
) -> tuple[PoseAdvice, ...]:
    best, correction = hand_eye.best, hand_eye.arm_correction
    T_base_flange = np.array([capture.T_base_flange for capture in captures])
    joints = np.array([capture.joints_rad for capture in captures])
    if correction is not None:
        arm_errors = corrected_mounting(correction).correction
        T_base_flange = corrected_T_base_flange(joints, T_base_flange, arm_errors)
    sigma_px = hand_eye.corner_sigma_px or _USUAL_CORNER_PX
    model = known_arm(arm) if arm else None

    def reachable(target: Transform) -> bool:
        near = joints[int(np.argmin(np.linalg.norm(T_base_flange[:, :3, 3] - target[:3, 3], axis=1)))]
        return model is None or nearest_posture(model, target, near) is not None

    points = Board(board.columns, board.rows, metres(board.square_mm)).points()
    suggested = suggest_board_poses(
        _answer(best), T_base_flange, points, camera, corner_sigma_px=sigma_px, count=POSES, reachable=reachable
    )
    T_board_base = inverse(np.array(best.T_base_board))
    middle = points.mean(axis=0)
    return tuple(_advice(pose, T_board_base @ pose.T_base_camera, middle) for pose in suggested)


def _advice(pose: SuggestedPose, T_board_camera: Transform, middle_m: Array) -> PoseAdvice:
    """A suggested pose as a person can follow it; `middle_m` (3,) is the middle of the board, in its frame."""
    away = T_board_camera[:3, 3] - middle_m
    axis, top = T_board_camera[:3, 2], -T_board_camera[:3, 1]
    x, y, z = (mm(float(v)) for v in pose.T_base_flange[:3, 3])
    return PoseAdvice(
        tilt_deg=deg(np.arccos(min(1.0, abs(float(axis[2]))))),
        azimuth_deg=deg(np.arctan2(away[1], away[0])),
        roll_deg=float(round(np.degrees(np.arctan2(top[0], -top[1])), 1)) % 360,
        distance_m=float(np.linalg.norm(away)),
        sigma_mm=pose.sigma_mm,
        sigma_deg=pose.sigma_deg,
        flange_mm=(x, y, z),
    )


def _answer(best: HandEye | ArmAnswer) -> HandEyeAnswer:
    sigma, noise, residuals = best.sigma, best.robot_noise, best.residuals
    return HandEyeAnswer(
        T_flange_camera=np.array(best.T_flange_camera),
        T_base_board=np.array(best.T_base_board),
        sigma_mm=_known(sigma.mm),
        sigma_deg=_known(sigma.deg),
        covariance=np.array(sigma.covariance),
        camera_share=np.zeros((6, 6)),  # it is part of the covariance, and is not needed separately here
        formal_covariance=None,
        robot_noise_mm=_known(noise.mm),
        robot_noise_deg=_known(noise.deg),
        residual_mm=np.array(list(residuals.mm.values())),
        residual_deg=np.array(list(residuals.deg.values())),
        held_out_mm=np.array(list(residuals.held_out_mm.values())),
        held_out_deg=np.array(list(residuals.held_out_deg.values())),
    )


def _known(value: float | None) -> float:
    return math.nan if value is None else value
