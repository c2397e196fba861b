"""Planned calibration on simulated scenes, with corners instead of images: cut boards, coverage, uncertainty, mount.

Each scene draws a new lens, mount, board position, arm errors and tape measurement. The steps `intrinsics` and
`hand_eye` are reproduced with the corners that the images would show, plus noise.
"""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bench.machine import REPOSITORY, RESULTS, commit, machine
from service.compute.arm_kinematics import matching_arm
from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.board_design import NOTHING, CalibrationTargets, ChosenViews
from service.compute.calibration.board_knowledge import BoardKnowledge, refined_knowledge
from service.compute.calibration.hand_eye import HandEyeViews, calibrate_hand_eye
from service.compute.calibration.intrinsics import calibrate_intrinsics, locate_view
from service.compute.calibration.intrinsics_quality import board_distance_m, projection_uncertainty
from service.compute.calibration.reprojection import board_corners
from service.compute.camera_model import CameraModel
from service.compute.planning.motion_plan import best_posture
from service.core.arms import arm_model
from service.core.geometry import Array, Transform, apply, inverse
from service.core.protocol import Motion
from service.rig import CollisionSection, LensSection
from service.steps.board_plan import START, PlannedBoard, Planner, Why, nominal_board, nominal_camera
from service.steps.context import StationLayout
from service.steps.motion import ArmAtStation, usual_posture
from service.steps.viewpoints import BoardPoses
from simulators.scene.world import SCENE_CENTRE_M, Scene, nominal_hand_eye

PROTOCOL = REPOSITORY / "protocols" / "exvivo_spine.yaml"
_WIDTH = 1920
_NOISE_PX = 0.06
_TAPE_SIGMA_M = 0.003
_STATION = "station_1"
_BOARD = Board(16, 23, 0.015)
_LENS = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_EDGE_PX = 12.0  # a corner closer to the edge of the image counts as cut off


@dataclass
class Shoot:
    """The images of one step."""

    views: list[BoardView] = field(default_factory=list[BoardView])
    flanges: list[Array] = field(default_factory=list[Array])
    joints: list[Array] = field(default_factory=list[Array])
    poses: int = 0
    cut: int = 0


class Room:
    """One scene: its nominal values, and what its images show."""

    def __init__(self, seed: int) -> None:
        self.scene = Scene.generate(seed)
        lens = self.scene.camera_intrinsics(_WIDTH).to_json()
        self.camera = CameraModel.from_record({key: lens[key] for key in _LENS})
        self.rng = np.random.default_rng([seed, 0xBE7C])
        self.layout = self._layout()
        self.mount = nominal_hand_eye()
        arm = arm_model("UR10e")
        station = ArmAtStation(self.layout, arm, self.mount, CollisionSection(arm="UR10e"), None, Motion())
        self.planning_scene = station.scene(usual_posture(arm, self.layout, self.mount))
        # The simulator's board has its 23 corners along x; ours has them along y.
        there = self.scene.board_placement(0)
        turn = np.array([[0, 1, 0, 0], [-1, 0, 0, 15 * 0.015], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        self.T_world_board = there @ turn

    def _layout(self) -> StationLayout:
        T_base_world = inverse(self.scene.T_world_base[_STATION])
        x, y, z = (float(v) for v in apply(T_base_world, SCENE_CENTRE_M) + self.rng.normal(0, _TAPE_SIGMA_M, 3))
        away = float(np.hypot(x, y))
        return StationLayout(_STATION, "robot", (x, y, z), (-x / away, -y / away, 0.0))

    def feasible(self, T_base_camera: Transform) -> bool:
        """Return whether the arm can reach a pose T_base_camera (4, 4)."""
        return best_posture(T_base_camera, self.planning_scene) is not None

    def photograph(self, sent: Transform, shoot: Shoot) -> None:
        """Take an image from the pose where a camera on the nominal mount would be at `sent`."""
        q = best_posture(sent, self.planning_scene)
        assert q is not None
        T_camera_board = inverse(self.scene.true_camera(q, _STATION)) @ self.T_world_board
        pixels = self.camera.project(apply(T_camera_board, _BOARD.points()))
        shoot.poses += 1
        size = np.array([self.camera.width, self.camera.height])
        if not ((pixels > _EDGE_PX) & (pixels < size - 1 - _EDGE_PX)).all():
            shoot.cut += 1
            return
        noisy = pixels + self.rng.normal(0, _NOISE_PX, pixels.shape)
        shoot.views.append(BoardView(np.arange(len(pixels)), noisy))
        shoot.flanges.append(self.scene.nominal_flange(q))
        shoot.joints.append(q)


def capture(
    room: Room, wanted: BoardPoses, solve: Sequence[str], nominal: BoardKnowledge, before: Shoot | None
) -> tuple[Shoot, PlannedBoard]:
    """Plan the images of a step stage by stage, as the step does, and take them."""
    aims = CalibrationTargets("intrinsics" in solve, "hand_eye" in solve, wanted.coverage)
    planner = Planner(wanted, _BOARD, aims, np.array(room.layout.approach), room.mount, room.feasible)
    lens_known = "intrinsics" not in solve
    shoot = Shoot()
    known = nominal if before is None else _refined(nominal, before, lens_known=lens_known)
    stages: list[tuple[Why, int]] = [("rest", wanted.count)]
    if before is None:
        stages = [("first", 1), ("start", START - 1), ("rest", wanted.count - START)]
    planned = None
    for why, count in stages:
        taken = NOTHING
        if shoot.views:
            known = _refined(nominal, shoot, lens_known=lens_known)
            poses = np.array(shoot.flanges) @ known.T_flange_camera
            taken = ChosenViews(poses, tuple(view.corners for view in shoot.views))
        planned = planner.next(why, count, known, taken, seed=shoot.poses)
        for T in planned.T_base_camera:
            room.photograph(planner.sent(T, known), shoot)
    assert planned is not None
    return shoot, planned


def _refined(nominal: BoardKnowledge, shoot: Shoot, *, lens_known: bool) -> BoardKnowledge:
    pick = np.unique(np.linspace(0, len(shoot.views) - 1, min(40, len(shoot.views))).round().astype(int))
    views, flanges = [shoot.views[k] for k in pick], np.array([shoot.flanges[k] for k in pick])
    return refined_knowledge(nominal, views, flanges, _BOARD, lens_known=lens_known)[0]


def measure(seed: int) -> dict[str, Any]:
    """Measure one scene."""
    steps = {step["id"]: step.get("params", {}) for step in yaml.safe_load(PROTOCOL.read_text())["steps"]}
    room = Room(seed)
    lens = LensSection(focal_length_mm=50, sensor_width_mm=35.7, image_px=(room.camera.width, room.camera.height))
    wanted = _poses(steps["intrinsics"]["board_poses"])
    nominal = nominal_board(wanted, _BOARD, room.layout, room.mount, *nominal_camera(lens))
    shoot, planned = capture(room, wanted, ("intrinsics",), nominal, None)
    solved = calibrate_intrinsics(shoot.views, _BOARD, (room.camera.width, room.camera.height))
    reached = projection_uncertainty(solved, board_distance_m(solved))
    wanted = _poses(steps["hand_eye"]["board_poses"])
    calibrated = nominal_board(wanted, _BOARD, room.layout, room.mount, solved.camera, 0.002)
    hand, hand_planned = capture(room, wanted, ("hand_eye",), calibrated, shoot)
    boards = np.array([locate_view(view, _BOARD, solved.camera)[0] for view in hand.views])
    flanges, joints = np.array(hand.flanges), np.array(hand.joints)
    answer = calibrate_hand_eye(
        HandEyeViews(
            flanges,
            boards,
            corners=board_corners(hand.views, _BOARD, solved.camera),
            joints_rad=joints,
            arm=matching_arm(joints, flanges),
        ),
        T_board_turned=_BOARD.half_turn(),
    )
    best = answer if answer.corrected is None else answer.corrected
    off = (best.T_flange_camera - room.scene.T_flange_camera)[:3, 3]
    return {
        "seed": seed,
        "poses": [shoot.poses, hand.poses],
        "cut": [shoot.cut, hand.cut],
        "coverage_predicted": round(planned.prediction.coverage, 3),
        "coverage_reached": round(solved.coverage, 3),
        "uncertainty_predicted_mm": round(planned.prediction.uncertainty_mm, 4),
        "uncertainty_reached_mm": round(reached.worst_mm, 4),
        "tilt_deg": round(float(solved.tilt_deg.max()), 1),
        "rotation_spread_deg": round(answer.rotation_spread_deg, 1),
        "hand_eye_sigma_predicted_mm": round(hand_planned.prediction.hand_eye_sigma_mm, 3),
        "hand_eye_sigma_reached_mm": round(best.sigma_mm, 3),
        "hand_eye_error_mm": round(1e3 * float(np.linalg.norm(off)), 3),
    }


def _poses(record: dict[str, Any]) -> BoardPoses:
    return BoardPoses.model_validate({k: tuple(v) if isinstance(v, list) else v for k, v in record.items()})


def _summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    def of(name: str) -> str:
        values = [row[name] for row in rows]
        return f"{statistics.median(values):.3g} ({min(values):.3g} … {max(values):.3g})"

    cut = [sum(row["cut"][k] for row in rows) for k in (0, 1)]
    poses = [sum(row["poses"][k] for row in rows) for k in (0, 1)]
    lines = ["| quantity | predicted | reached |", "|---|---|---|"]
    lines.append(f"| boards cut, of {poses[0]} images of the intrinsics | 0 | {cut[0]} |")
    lines.append(f"| boards cut, of {poses[1]} images of the hand-eye | 0 | {cut[1]} |")
    for words, name in (
        ("coverage of the image", "coverage_{}"),
        ("uncertainty of a projected point, worst in the image, mm", "uncertainty_{}_mm"),
        ("σ of T_flange_camera, mm", "hand_eye_sigma_{}_mm"),
    ):
        lines.append(f"| {words} | {of(name.format('predicted'))} | {of(name.format('reached'))} |")
    lines.append(f"| true error of T_flange_camera, mm | | {of('hand_eye_error_mm')} |")
    lines.append(f"| largest tilt, ° | | {of('tilt_deg')} |")
    lines.append(f"| rotation spread, ° | | {of('rotation_spread_deg')} |")
    return lines


def main() -> None:
    """Measure and write bench/results/calibration_plan.{json,md}."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--first", type=int, default=1, help="seed of the first scene")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.scenes)
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        rows: list[dict[str, Any]] = []
        for row in pool.map(measure, seeds):
            rows.append(row)
            print(json.dumps(row), flush=True)
    record = {
        "machine": machine(),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "calibration_plan.json").write_text(json.dumps({**record, "scenes": rows}, indent=1) + "\n")
    head = [
        "# Planned calibration images against the truth",
        "",
        f"{len(rows)} scenes (seeds {seeds.start} … {seeds[-1]}), 1920 × 1280 px, corners with {_NOISE_PX} px of "
        f"noise, protocols/exvivo_spine.yaml; median (least … largest). {record['date']}, {record['commit']}.",
        "",
    ]
    (args.out / "calibration_plan.md").write_text("\n".join([*head, *_summary(rows)]) + "\n")


if __name__ == "__main__":
    main()
