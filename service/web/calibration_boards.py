"""The board images of a calibration: those planned, with their drawing, and those that would improve it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from service.computations.calibration import ArmAnswer, HandEye
from service.computations.conversion import corrected_mounting
from service.computations.records import Camera
from service.compute.arm_kinematics import corrected_T_base_flange, nearest_posture
from service.compute.calibration.board import Board
from service.compute.calibration.hand_eye import HandEyeAnswer
from service.compute.calibration.next_poses import SuggestedPose, suggest_board_poses
from service.compute.camera_model import CameraModel
from service.core.arms import known_arm
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.geometry import Array, Transform, inverse
from service.core.protocol import CalibrationBoard as BoardSection
from service.core.records.run_events import ViewpointCaptured
from service.core.units import deg, metres, mm
from service.core.words import counted
from service.followed_run import RunRecord
from service.rig import Rig
from service.steps.board_plan import describe_prediction
from service.steps.context import StationLayout
from service.steps.kinds.calibration import Params
from service.steps.notes import BOARD_POSES, board_plans
from service.steps.plan_preview import preview_board_poses
from service.web.images import cached, recorded_rig_section
from service.web.planned_poses import station_of

POSES = 6
_USUAL_CORNER_PX = 0.1  # 1σ of a board corner, for records that do not state it
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "centre", "right")


@dataclass(frozen=True, slots=True)
class PoseAdvice:
    """A board pose worth taking, as the pose of the camera relative to the board.

    Attributes:
        tilt_deg: tilt of the optical axis from the board's normal.
        azimuth_deg: direction of the tilt, in the board's plane.
        roll_deg: roll of the image about the optical axis, against the one nearest to upright.
        distance_m: distance to the board's middle.
        sigma_mm, sigma_deg: 1σ of the hand-eye transform once this and the earlier poses are taken.
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
    """Return the ninths of the image in which cells hold no corner, worst first: name, such cells, all cells."""
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
    """Return suggested poses, computed once for a calibration and cached; none if the linear problem has no solution.

    Args:
        hand_eye: the hand-eye calibration.
        camera: the calibrated camera.
        captures: the board images that it used.
        board: the calibration board.
        arm: model name; poses that it does not reach are left out, where its kinematics are known.
        data: the data folder, in which the result is cached.
        key: the key of the calibration, such as its file's hash.
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
    """Return a suggested pose as a person can follow it; `middle_m` (3,) is the middle of the board, in its frame."""
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


_WIDTH, _HEIGHT = 760, 342
_CELL = 29
_LEFT, _TOP = 16, 74
_INK, _PAPER, _FAINT, _ACCENT = "#1d2733", "#ffffff", "#8895a3", "#1f6fb2"
_PLAN_LEFT, _PLAN_SIZE = 430, 240
_TICK = 12.0


def board_plan_svg(text: str, counts: Sequence[Sequence[int]], T_base_camera: Array, approach: Array) -> str:
    """Return the drawing of a plan of board images as an SVG document.

    Args:
        text: the prediction of what the plan gives.
        counts: (8, 12) corners expected in each cell of the image.
        T_base_camera: (K, 4, 4) planned poses, those taken already included.
        approach: (3,) horizontal unit vector from the scene towards the robot, which is below in the drawing.
    """
    most = max(1, *(n for row in counts for n in row))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" rx="6" fill="{_PAPER}"/>',
        *(_text(_LEFT, 20 + 17 * k, line, 12, weight="bold") for k, line in enumerate(text.split("; ", 1))),
        _text(_LEFT, _TOP - 10, "Corners expected in each part of the image", 12),
        _text(_PLAN_LEFT, _TOP - 10, "Camera from above; the robot stands below", 12),
    ]
    for r, row in enumerate(counts):
        for c, n in enumerate(row):
            x, y = _LEFT + c * _CELL, _TOP + r * _CELL
            share = math.sqrt(n / most)
            fill = f'fill="{_ACCENT}" fill-opacity="{0.08 + 0.72 * share:.2f}"' if n else 'fill="none"'
            parts.append(f'<rect x="{x}" y="{y}" width="{_CELL}" height="{_CELL}" {fill} stroke="{_FAINT}"/>')
            ink = _PAPER if share > 0.75 else _INK
            parts.append(_text(x + _CELL / 2, y + _CELL / 2 + 4, str(n) if n else "–", 10, ink, anchor="middle"))
    parts += _cameras(T_base_camera, approach)
    return "\n".join([*parts, "</svg>"])


def _cameras(T_base_camera: Array, approach: Array) -> list[str]:
    if not len(T_base_camera):
        return []
    side = np.cross([0.0, 0.0, 1.0], approach)
    eyes, looks = T_base_camera[:, :3, 3], T_base_camera[:, :3, 2]
    places = np.column_stack([eyes @ side, eyes @ approach])
    low, high = places.min(axis=0), places.max(axis=0)
    scale = (_PLAN_SIZE - 2 * _TICK) / max(float((high - low).max()), 0.05)
    at = (places - (low + high) / 2) * scale + [_PLAN_LEFT + _PLAN_SIZE / 2, _TOP + _PLAN_SIZE / 2]
    ticks = np.column_stack([looks @ side, looks @ approach]) * _TICK
    out: list[str] = []
    for (x, y), (dx, dy) in zip(at, ticks, strict=True):
        line = f'x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        out.append(f'<line {line} stroke="{_ACCENT}"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{_INK}"/>')
    bar = 0.1 * scale
    y = _TOP + _PLAN_SIZE + 14
    out.append(f'<line x1="{_PLAN_LEFT}" y1="{y}" x2="{_PLAN_LEFT + bar:.1f}" y2="{y}" stroke="{_INK}"/>')
    out.append(_text(_PLAN_LEFT + bar + 6, y + 4, "100 mm", 11))
    return out


def _text(
    x: float, y: float, words: str, size: int, ink: str = _INK, *, anchor: str = "start", weight: str = ""
) -> str:
    style = f' font-weight="{weight}"' if weight else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{ink}" text-anchor="{anchor}"{style}>'
        f"{escape(words)}</text>"
    )


def board_plan_of(log: RunRecord, step_id: str, data: Path) -> bytes:
    """Return the plan as an SVG document, computed once for each recorded state of a step.

    Raises:
        ProtocolError: no such step.
        ConfigurationError: the software plans no board images in it.
    """
    step = log.protocol.step(step_id)
    wanted = step.params.board_poses if isinstance(step.params, Params) else None
    if wanted is None:
        raise ConfigurationError("no board images are planned in this step", where=f"step {step_id}")
    solve = step.params_as(Params).solve
    state = log.state.steps[step_id]
    plans = board_plans(state)

    def layout(name: str) -> StationLayout:
        station = station_of(log, name)
        if station is None:
            raise ConfigurationError(f"the rig has no station {name!r}", where=f"step {step_id}")
        return station.layout

    def make() -> bytes:
        approach = np.array(layout(wanted.station).approach)
        if plans:
            poses = np.array([pose.T_base_camera for plan in plans for pose in plan.poses])
            predicted = plans[-1].prediction
            text = f"{counted(len(poses), 'board pose')} so far; predicted {describe_prediction(predicted, solve)}"
            return board_plan_svg(text, predicted.coverage_map, poses, approach).encode()
        try:
            found = preview_board_poses(log.protocol, step, Rig(recorded_rig_section(log), Path(), b""), layout)
        except OrthocaptureError as error:
            return board_plan_svg(str(error), [[0] * 12] * 8, np.zeros((0, 4, 4)), approach).encode()
        assert found is not None  # the step plans board images
        return board_plan_svg(found.text, found.prediction.coverage_map, found.T_base_camera, approach).encode()

    newest = max((note.seq for note in state.notes if note.note == BOARD_POSES), default=0)
    return cached(data, f"board plan {log.state.run_id} {step_id} {newest}", ".svg", make).read_bytes()
