"""Calibrates the hand-eye transform of simulated arms that err in a stated way, and measures what remains."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.arm_kinematics import CorrectedMounting
from service.compute.calibration.hand_eye import HandEyeViews, calibrate_hand_eye
from service.core.arms import arm_model
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points, apply, transform
from service.core.units import mm
from simulators.scene.arm import ArmErrorKind, UniversalRobot
from simulators.scene.world import Scene
from tests.support.boards.board_sessions import Shot, board_session, plan, scene_error_mm


@dataclass(frozen=True, slots=True)
class BoardImages:
    """Which images of the board are taken: steps of a protocol, and their width."""

    protocol: str
    steps: tuple[str, ...]
    width: int


SESSIONS = {
    "demonstration, 14 images": BoardImages("demo", ("camera_calibration",), 1280),
    "hand-eye step, 30 images": BoardImages("exvivo_spine", ("hand_eye",), 4752),
    "intrinsics and hand-eye steps, 120 images": BoardImages("exvivo_spine", ("intrinsics", "hand_eye"), 4752),
}
CAPTURES = ("viewpoint_capture_1", "viewpoint_capture_2")
_VIEW_M = 0.65  # distance of the scene's centre in front of the camera


def hand_eye_of(kind: ArmErrorKind, session: str, seed: int) -> dict[str, Any]:
    """Calibrate one arm and judge it at the captures' viewpoints."""
    scene = Scene.generate(seed, arm_errors=kind)
    images = SESSIONS[session]
    views = plan(scene, images.protocol, *CAPTURES)
    seen = board_session(scene, plan(scene, images.protocol, *images.steps), width=images.width)
    row: dict[str, Any] = {
        "errors": kind,
        "session": session,
        "seed": seed,
        "images": len(seen.T_base_flange),
    }
    begun_s = time.monotonic()
    found = HandEyeViews(
        seen.T_base_flange,
        seen.T_camera_board,
        corners=seen.corners,
        joints_rad=seen.joints_rad,
        arm=arm_model(scene.arm.name),
    )
    try:
        result = calibrate_hand_eye(found)
    except ComputeError as error:
        return row | {"refused": str(error)}
    reported = np.array([scene.nominal_flange(shot.q) for shot in views])
    row |= {
        "plain_mm": scene_error_mm(scene, views, reported @ result.T_flange_camera),
        "seconds": time.monotonic() - begun_s,
    }
    if result.corrected is not None:
        mounting = CorrectedMounting(result.corrected.correction, result.corrected.T_flange_camera)
        poses = mounting.T_base_camera(np.array([shot.q for shot in views]), reported)
        apart_mm = systematic_mm(scene, views, poses)
        away_m = (mounting.T_flange_camera - seen_from_nominal_flange(scene))[:3, 3]
        row |= {
            "terms": result.corrected.terms,
            "corrected_mm": scene_error_mm(scene, views, poses),
            "systematic_mm": float(np.sqrt(np.mean(apart_mm**2))),
            "worst_mm": float(apart_mm.max()),
            "held_out_mm": float(np.sqrt(np.mean(result.corrected.held_out_mm**2))),
            "robot_noise_mm": result.corrected.robot_noise_mm,
            "mount_sigmas": mm(float(np.linalg.norm(away_m))) / result.corrected.sigma_mm,
        }
    return row


def seen_from_nominal_flange(scene: Scene) -> Array:
    """T_flange_camera with the flange where its controller has it: errors of the last link look like a mount."""
    assert isinstance(scene.arm, UniversalRobot)
    a, d, alpha, theta, _ = scene.arm.errors.dh_deltas[5]
    turn, twist = (Rotation.from_euler(axis, angle) for axis, angle in (("z", theta), ("x", alpha)))
    return transform(turn * twist, turn.apply([a, 0.0, d])) @ scene.T_flange_camera


def systematic_mm(scene: Scene, shots: list[Shot], T_base_camera: Array) -> Array:
    """(N,) error of where a camera puts the scene's centre, each station's base aligned, had the arm no scatter."""
    about = np.array([[0, 0, _VIEW_M], [0.1, 0, _VIEW_M], [0, 0.1, _VIEW_M], [0, 0, _VIEW_M - 0.1], [0, 0, 0.0]])
    apart = np.zeros(len(shots))
    for station in sorted({shot.station for shot in shots}):
        mine = [i for i, shot in enumerate(shots) if shot.station == station]
        cameras = [scene.arm.true(shots[i].q) @ scene.T_flange_camera for i in mine]
        true = np.array([apply(T, about) for T in cameras])
        found = np.array([apply(T_base_camera[i], about) for i in mine])
        T, _ = align_points(true.reshape(-1, 3), found.reshape(-1, 3))
        apart[mine] = np.linalg.norm(apply(T, found[:, 0]) - true[:, 0], axis=1)
    return mm(apart)
