"""Which board images to add: parts of the image without corners, and poses that improve the hand-eye calibration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.compute.arm.correction import corrected_T_base_flange
from service.compute.arm.inverse_kinematics import nearest_posture
from service.compute.calibration.board.board import Board
from service.compute.calibration.board_poses.plan import suggest_board_poses
from service.compute.calibration.hand_eye.answers import HandEyeAnswer
from service.compute.calibration.hand_eye.record import read_arm_correction
from service.compute.camera_model import CameraModel
from service.core.errors import OrthocaptureError
from service.core.geometry import Transform, inverse
from service.core.protocol.models import Board as BoardSection
from service.core.records.events import ViewpointCaptured
from service.core.units import deg, metres, mm
from service.steps.capture.plan.planning import known_arm
from service.web.record.pictures import cached

POSES = 6
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


def empty_regions(corners: Sequence[Sequence[int]]) -> list[tuple[str, int, int]]:
    """Ninths of the image that have cells without corners: name, empty cells, all its cells; worst first."""
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
    record: Mapping[str, Any],
    camera: Mapping[str, Any],
    captures: Sequence[ViewpointCaptured],
    board: BoardSection,
    arm: str,
    data: Path,
    key: str,
) -> tuple[PoseAdvice, ...]:
    """Suggested poses, computed once for a calibration and cached; none if the linearised problem has no solution.

    Args:
        record: of the hand-eye calibration.
        captures: the board images that it used.
        arm: model name; poses that it does not reach are left out, where its kinematics are known.
        key: of the calibration, such as its file's hash.
    """

    def make() -> bytes:
        try:
            found = _advise(record, CameraModel.from_record(dict(camera)), captures, board, arm)
        except (OrthocaptureError, np.linalg.LinAlgError):
            found = ()
        return json.dumps([asdict(pose) for pose in found]).encode()

    kept: list[dict[str, Any]] = json.loads(cached(data, f"board poses {key}", ".json", make).read_bytes())
    return tuple(PoseAdvice(**pose) for pose in kept)


def _advise(
    record: Mapping[str, Any],
    camera: CameraModel,
    captures: Sequence[ViewpointCaptured],
    board: BoardSection,
    arm: str,
) -> tuple[PoseAdvice, ...]:
    best = record["arm_correction"] or record
    T_base_flange = np.array([capture.T_base_flange for capture in captures])
    joints = np.array([capture.joints_rad for capture in captures])
    if record["arm_correction"]:
        T_base_flange = corrected_T_base_flange(joints, T_base_flange, read_arm_correction(best).correction)
    sigma_px = float(record.get("corner_sigma_px") or 0.1)
    model = known_arm(arm) if arm else None

    def reachable(target: Transform) -> bool:
        near = joints[int(np.argmin(np.linalg.norm(T_base_flange[:, :3, 3] - target[:3, 3], axis=1)))]
        return model is None or nearest_posture(model, target, near) is not None

    points = Board(board.columns, board.rows, metres(board.square_mm)).points()
    suggested = suggest_board_poses(
        _answer(best), T_base_flange, points, camera, corner_sigma_px=sigma_px, count=POSES, reachable=reachable
    )
    T_board_base = inverse(np.array(best["T_base_board"]))
    middle = points.mean(axis=0)
    out: list[PoseAdvice] = []
    for pose in suggested:
        T_board_camera = T_board_base @ pose.T_base_camera
        away = T_board_camera[:3, 3] - middle
        axis, top = T_board_camera[:3, 2], -T_board_camera[:3, 1]
        x, y, z = (mm(float(v)) for v in pose.T_base_flange[:3, 3])
        out.append(
            PoseAdvice(
                tilt_deg=deg(np.arccos(min(1.0, abs(float(axis[2]))))),
                azimuth_deg=deg(np.arctan2(away[1], away[0])),
                roll_deg=float(round(np.degrees(np.arctan2(top[0], -top[1])), 1)) % 360,
                distance_m=float(np.linalg.norm(away)),
                sigma_mm=pose.sigma_mm,
                sigma_deg=pose.sigma_deg,
                flange_mm=(x, y, z),
            )
        )
    return tuple(out)


def _answer(record: Mapping[str, Any]) -> HandEyeAnswer:
    residuals = {name: np.array(list(values.values())) for name, values in record["residuals"].items()}
    return HandEyeAnswer(
        T_flange_camera=np.array(record["T_flange_camera"]),
        T_base_board=np.array(record["T_base_board"]),
        sigma_mm=record["sigma"]["mm"],
        sigma_deg=record["sigma"]["deg"],
        covariance=np.array(record["sigma"]["covariance"]),
        camera_share=np.zeros((6, 6)),  # it is part of the covariance, and is not needed separately here
        formal_covariance=None,
        robot_noise_mm=record["robot_noise"]["mm"],
        robot_noise_deg=record["robot_noise"]["deg"],
        residual_mm=residuals["mm"],
        residual_deg=residuals["deg"],
        held_out_mm=residuals["held_out_mm"],
        held_out_deg=residuals["held_out_deg"],
    )
