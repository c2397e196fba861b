"""Board images and data set viewpoints of simulated scenes, reduced to geometry: joints, poses, noisy corners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from service.compute.arm_kinematics import nearest_posture
from service.compute.calibration.board import Board
from service.compute.calibration.board_design import CalibrationTargets
from service.compute.calibration.reprojection import BoardCorners
from service.compute.camera_model import CameraModel
from service.core.arms import arm_model
from service.core.geometry import Array, align_points, apply, inverse, look_at, transform
from service.rig import LensSection
from service.steps.board_plan import Planner, nominal_board, nominal_camera, preview_board
from service.steps.context import StationLayout
from service.steps.motion import usual_posture
from service.steps.viewpoints import BoardPoses, ViewpointSet, flange_target, plan_viewpoints
from simulators.scene.arm import ARM_MODEL
from simulators.scene.world import SCENE_CENTRE_M, Scene, nominal_hand_eye
from simulators.ur_controller.kinematics import inverse as joints_for

PROTOCOLS = Path(__file__).parents[3] / "protocols"
BOARD = Board(23, 16, 0.015)
_NEAR = np.array([1.57, -1.5, 1.9, -2.0, -1.57, 0.0])
T_FLANGE_CAMERA = transform(Rotation.from_rotvec([0.02, -0.03, 1.55]), np.array([0.012, -0.055, 0.093]))
T_BASE_BOARD = transform(Rotation.from_euler("xyz", [176, 3, 40], degrees=True), np.array([0.7, -0.1, 0.05]))
CAMERA = CameraModel(4752, 3168, 6650.0, 6652.0, 2380.0, 1580.0, -0.05, 0.03, 2e-4, -3e-4)
_VIEW_M = 0.65  # distance of the scene's centre in front of the camera


@dataclass(frozen=True, slots=True)
class Shot:
    """One viewpoint: its station and the arm's joints."""

    station: str
    q: Array


@dataclass(frozen=True, slots=True)
class Session:
    """The input of a hand-eye calibration with N views."""

    T_base_flange: Array
    T_camera_board: Array
    corners: BoardCorners
    joints_rad: Array


def plan(scene: Scene, protocol: str, *steps: str) -> list[Shot]:
    """The reachable viewpoints of these steps, as a protocol plans them."""
    text = yaml.safe_load((PROTOCOLS / f"{protocol}.yaml").read_text(encoding="utf-8"))
    by_id = {step["id"]: step for step in text["steps"]}
    shots: list[Shot] = []
    for step in steps:
        params = by_id[step]["params"]
        if "board_poses" in params:
            shots += planned_board_shots(
                scene, BoardPoses.model_validate(_tuples(params["board_poses"])), params["solve"]
            )
        for record in params.get("viewpoints", ()):
            wanted = ViewpointSet.model_validate(record)
            layout = _layout(scene, wanted.station)
            joints = _joints(scene, layout)
            for viewpoint in plan_viewpoints(wanted, layout):
                q = joints(viewpoint.T_base_camera)
                if q is not None:
                    shots.append(Shot(wanted.station, q))
    return shots


def _tuples(record: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in record.items()}


def planned_board_shots(scene: Scene, wanted: BoardPoses, solve: Sequence[str]) -> list[Shot]:
    """The board images of a calibration, planned by the software for nominal camera, mount and board."""
    board, layout, mount = Board(16, 23, 0.015), _layout(scene, wanted.station), nominal_hand_eye()
    lens = LensSection(focal_length_mm=50, sensor_width_mm=35.7, image_px=(4752, 3168))
    known = nominal_board(wanted, board, layout, mount, *nominal_camera(lens))
    joints = _joints(scene, layout)
    aims = CalibrationTargets("intrinsics" in solve, "hand_eye" in solve, wanted.coverage)
    planner = Planner(wanted, board, aims, np.array(layout.approach), mount, lambda T: joints(T) is not None)
    found = [joints(T) for T in preview_board(planner, known).T_base_camera]
    return [Shot(wanted.station, q) for q in found if q is not None]


def _joints(scene: Scene, layout: StationLayout) -> Callable[[Array], Array | None]:
    """The joints with which the scene's arm takes a T_base_camera; None if it is out of reach."""
    mount = nominal_hand_eye()
    if scene.arm.name == ARM_MODEL.name:
        return lambda T: joints_for(ARM_MODEL, flange_target(T, mount), _NEAR)
    arm = arm_model(scene.arm.name)
    start = usual_posture(arm, layout, mount)
    return lambda T: nearest_posture(arm, flange_target(T, mount), start)


def _layout(scene: Scene, station: str) -> StationLayout:
    centre = apply(inverse(scene.T_world_base[station]), SCENE_CENTRE_M)
    towards = -centre[:2] / np.linalg.norm(centre[:2])
    x, y, z = (float(v) for v in centre)
    return StationLayout(station, "robot", (x, y, z), (float(towards[0]), float(towards[1]), 0.0))


def board_session(scene: Scene, shots: Sequence[Shot], *, sigma_px: float = 0.05, width: int = 4752) -> Session:
    """The board as the images show it: all views that contain the whole board, with white noise on the corners."""
    lens = scene.camera_intrinsics(width).to_json()
    camera = CameraModel.from_record({key: lens[key] for key in _CAMERA})
    rng = np.random.default_rng([scene.seed, 7])
    T_world_board = scene.board_placement(0)
    flanges: list[Array] = []
    boards: list[Array] = []
    corners: list[Array] = []
    joints: list[Array] = []
    for shot in shots:
        T_camera_board = inverse(scene.true_camera(shot.q, shot.station)) @ T_world_board
        pixels = camera.project(apply(T_camera_board, BOARD.points()))
        if not ((pixels > 0) & (pixels < [camera.width, camera.height])).all():
            continue
        pixels = pixels + rng.normal(0, sigma_px, pixels.shape)
        flanges.append(scene.nominal_flange(shot.q))
        boards.append(locate(BOARD.points(), pixels, camera, T_camera_board))
        corners.append(pixels)
        joints.append(shot.q)
    return Session(
        np.array(flanges), np.array(boards), BoardCorners(BOARD.points(), np.array(corners), camera), np.array(joints)
    )


def noisy_session(count: int, mm: float, deg: float, seed: int, *, sigma_px: float = 0.05) -> Session:
    """Views from all sides by an arm with independent pose noise per axis; the joints are left at zero."""
    rng = np.random.default_rng([seed, count])
    points = BOARD.points()
    centre = points.mean(axis=0)
    hands: list[Array] = []
    boards: list[Array] = []
    corners: list[Array] = []
    while len(hands) < count:
        tilt, azimuth = np.deg2rad(rng.uniform(5, 40)), rng.uniform(0, 2 * np.pi)
        out = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
        target, up = centre + rng.uniform(-0.02, 0.02, 3), np.array([rng.normal(0, 0.3), -1.0, 0.0])
        roll = transform(Rotation.from_euler("z", 180.0 * rng.integers(2), degrees=True), np.zeros(3))
        T_board_camera = look_at(centre + 0.75 * out, target, up) @ roll
        T_camera_board = inverse(T_board_camera)
        pixels = CAMERA.project(apply(T_camera_board, points))
        if not ((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height])).all():
            continue
        pixels = pixels + rng.normal(0, sigma_px, pixels.shape)
        wobble = transform(Rotation.from_rotvec(np.deg2rad(rng.normal(0, deg, 3))), rng.normal(0, mm, 3) * 1e-3)
        hands.append(T_BASE_BOARD @ T_board_camera @ inverse(T_FLANGE_CAMERA) @ wobble)
        boards.append(locate(points, pixels, CAMERA, T_camera_board))
        corners.append(pixels)
    return Session(
        np.array(hands), np.array(boards), BoardCorners(points, np.array(corners), CAMERA), np.zeros((count, 6))
    )


@dataclass(frozen=True)
class OddScene(Scene):
    """A scene whose arm has errors that no term of the correction describes exactly.

    In addition to the usual errors: two gear waves per joint with non-integer numbers of periods, and links that sag
    under their weight.
    """

    def true_flange(self, q: Array, station: str) -> Array:
        """The true T_world_flange."""
        rng = np.random.default_rng([self.seed, 0x0DD])
        waves = rng.uniform(1.5, 7.5, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6))
        more = np.radians(0.006) * np.sin(waves[0] * q + waves[1]).sum(axis=0)
        sag = np.zeros(6)
        sag[1] = np.radians(0.02) * np.cos(q[1])
        sag[2] = np.radians(0.01) * np.cos(q[1] + q[2])
        return super().true_flange(q + more + sag, station)


_CAMERA = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def locate(points: Array, pixels: Array, camera: CameraModel, near: Array) -> Array:
    """The T_camera_board of least reprojection error, found from a start nearby."""
    rvec, tvec = cv2.solvePnPRefineLM(
        points, pixels, camera.matrix, camera.distortion, cv2.Rodrigues(near[:3, :3])[0], near[:3, 3].copy()
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rvec)[0], np.asarray(tvec).ravel()
    return T


def scene_error_mm(scene: Scene, shots: Sequence[Shot], T_base_camera: Array) -> float:
    """RMS error of the scene centre's position from the camera poses, with each station's base aligned."""
    about = np.array([[0, 0, _VIEW_M], [0.1, 0, _VIEW_M], [0, 0.1, _VIEW_M], [0, 0, _VIEW_M - 0.1], [0, 0, 0.0]])
    squares: list[Any] = []
    for station in sorted({shot.station for shot in shots}):
        mine = [i for i, shot in enumerate(shots) if shot.station == station]
        true = np.array([apply(scene.true_camera(shots[i].q, station), about) for i in mine])
        found = np.array([apply(T_base_camera[i], about) for i in mine])
        T, _ = align_points(true.reshape(-1, 3), found.reshape(-1, 3))
        squares += list(np.sum((apply(T, found[:, 0]) - true[:, 0]) ** 2, axis=1))
    return 1e3 * float(np.sqrt(np.mean(squares)))
