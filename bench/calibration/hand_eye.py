"""Hand-eye calibration against ground truth: independent robot noise, systematic arm errors, unusual arms."""

from __future__ import annotations

import argparse
import datetime
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.machine import RESULTS, commit, machine
from service.compute.arm_kinematics import corrected_T_base_flange
from service.compute.calibration.hand_eye import HandEyeResult, HandEyeViews, calibrate_hand_eye
from service.core.arms import arm_model
from service.core.geometry import Array
from simulators.scene.world import ARMS, Scene
from tests.support.boards.board_sessions import (
    T_FLANGE_CAMERA,
    OddScene,
    Session,
    Shot,
    board_session,
    noisy_session,
    plan,
    scene_error_mm,
)

NOISES = ((90, 0.05, 0.005), (60, 0.05, 0.005), (90, 0.15, 0.02), (20, 0.15, 0.02))  # images, mm, degrees
SESSIONS = (
    ("demo, 14 images", "demo", ("camera_calibration",)),
    ("hand-eye step, 30 images", "exvivo_spine", ("hand_eye",)),
    ("intrinsics and hand-eye steps, 120 images", "exvivo_spine", ("intrinsics", "hand_eye")),
)
DATASET = ("viewpoint_capture_1", "viewpoint_capture_2")


def independent_noise(seeds: int) -> list[dict[str, Any]]:
    """Median error of T_flange_camera by method, and the ratio of error to stated sigma for the default method."""
    rows: list[dict[str, Any]] = []
    for count, mm, deg in NOISES:
        errors: dict[str, list[float]] = {}
        ratios: list[float] = []
        squares: list[float] = []
        for seed in range(seeds):
            session = noisy_session(count, mm, deg, seed)
            result = calibrate_hand_eye(
                HandEyeViews(session.T_base_flange, session.T_camera_board, corners=session.corners)
            )
            for method, T in result.methods.items():
                errors.setdefault(method, []).append(1e3 * float(np.linalg.norm((T - T_FLANGE_CAMERA)[:3, 3])))
            ratios.append(errors["weighted"][-1] / result.sigma_mm)
            squares.append(_chi_squared(result))
        rows.append(
            {
                "images": count,
                "robot_mm": mm,
                "robot_deg": deg,
                "error_mm": {method: float(np.median(values)) for method, values in errors.items()},
                "worst_mm": {method: max(values) for method, values in errors.items()},
                "error_over_sigma_rms": float(np.sqrt(np.mean(np.square(ratios)))),
                "within_3_sigma": float(np.mean(np.array(ratios) < 3)),
                "chi2_over_6": float(np.mean(squares)) / 6,
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


def _chi_squared(result: HandEyeResult) -> float:
    gap = np.concatenate(
        [
            (T_FLANGE_CAMERA - result.T_flange_camera)[:3, 3],
            Rotation.from_matrix(T_FLANGE_CAMERA[:3, :3] @ result.T_flange_camera[:3, :3].T).as_rotvec(),
        ]
    )
    return float(gap @ np.linalg.solve(result.covariance, gap))


def systematic_arm(
    kind: type[Scene], sessions: Sequence[tuple[str, str, tuple[str, ...]]], seeds: list[int], arm: str = ARMS[0]
) -> list[dict[str, Any]]:
    """Error at the scene's centre over the 108 viewpoints of both stations, by method, for each seed."""
    rows: list[dict[str, Any]] = []
    for name, protocol, steps in sessions:
        for seed in seeds:
            scene = kind.generate(seed, arm=arm, arm_errors="gears")
            views = plan(scene, "exvivo_spine", *DATASET)
            session = board_session(scene, plan(scene, protocol, *steps))
            rows.append({"session": name, "seed": seed, **_one(scene, views, session)})
            print(json.dumps(rows[-1]), flush=True)
    return rows


def _one(scene: Scene, views: list[Shot], session: Session) -> dict[str, Any]:
    joints = np.array([shot.q for shot in views])
    reported = np.array([scene.nominal_flange(shot.q) for shot in views])
    begun = time.monotonic()
    result = calibrate_hand_eye(
        HandEyeViews(
            session.T_base_flange,
            session.T_camera_board,
            corners=session.corners,
            joints_rad=session.joints_rad,
            arm=arm_model(scene.arm.name),
        )
    )
    seconds = time.monotonic() - begun
    errors = {name: scene_error_mm(scene, views, reported @ T) for name, T in result.methods.items()}
    if result.corrected is not None:
        poses = corrected_T_base_flange(joints, reported, result.corrected.correction)
        errors["arm corrected"] = scene_error_mm(scene, views, poses @ result.corrected.T_flange_camera)
    best: Array = (result.corrected or result).held_out_mm
    return {
        "images": len(session.T_base_flange),
        "error_mm": errors,
        "held_out_median_mm": float(np.median(best)),
        "held_out_rms_mm": result.arm_held_out_mm,
        "seconds": seconds,
    }


def as_markdown(record: dict[str, Any]) -> str:
    """Format the record as Markdown."""
    lines = [
        f"# Hand-eye calibration, {record['date']}",
        "",
        f"Commit {record['commit']}. Geometry only: a board of 24 × 17 squares of 15 mm at 4752 × 3168 px, "
        "corner noise 0.05 px for each axis.",
        "",
        "## Robot with independent noise: error of T_flange_camera (mm), median over seeds",
        "",
        "| images | robot noise | " + " | ".join(METHODS) + " | error / sigma (rms) | chi²/6 |",
        "|---:|---|" + "---:|" * (len(METHODS) + 2),
    ]
    for row in record["independent"]:
        figures = " | ".join(f"{row['error_mm'].get(m, float('nan')):.3f}" for m in METHODS)
        lines.append(
            f"| {row['images']} | {row['robot_mm']} mm, {row['robot_deg']}° | {figures} | "
            f"{row['error_over_sigma_rms']:.2f} | {row['chi2_over_6']:.2f} |"
        )
    lines += ["", "## The simulated arm (0.5 mm geometry, 0.5 mm gears): held-out viewpoints of both stations", ""]
    lines += _viewpoints(record["systematic"])
    lines += ["", "## An arm that errs in other ways too: waves between whole periods, sagging links", ""]
    lines += _viewpoints(record["odd"])
    return "\n".join(lines) + "\n"


def arm_as_markdown(record: dict[str, Any]) -> str:
    """Format the record of one arm as Markdown."""
    lines = [
        f"# Hand-eye calibration of a simulated {record['arm']}, {record['date']}",
        "",
        f"Commit {record['commit']}. Geometry only: a board of 24 × 17 squares of 15 mm at 4752 × 3168 px, "
        "corner noise 0.05 px for each axis. The arm's errors are not of the form that is estimated: links displaced "
        "in all directions (0.5 mm rms at the flange), gears with waves between whole periods (0.5 mm), joints that "
        "yield to gravity (0.3 mm), and a repeatability of ±0.15 mm (0.07 mm rms).",
        "",
        *_viewpoints(record["systematic"]),
    ]
    return "\n".join(lines) + "\n"


def _viewpoints(rows: list[dict[str, Any]]) -> list[str]:
    names = ("arm corrected", *METHODS)
    lines = [
        "RMS error (mm) of where the camera puts the scene's centre, over the 108 viewpoints of the data set.",
        "",
        "| session | seed | images | " + " | ".join(names) + " | own held-out (mm) |",
        "|---|---:|---:|" + "---:|" * (len(names) + 1),
    ]
    for row in rows:
        figures = " | ".join(f"{row['error_mm'][m]:.3f}" if m in row["error_mm"] else "–" for m in names)
        lines.append(
            f"| {row['session']} | {row['seed']} | {row['images']} | {figures} | {row['held_out_median_mm']:.3f} |"
        )
    return lines


METHODS = ("weighted", "park", "daniilidis", "tsai", "horaud", "andreff", "reprojection")


def main() -> None:
    """Measure, print and write both result files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds (5)")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat())
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--arm", choices=ARMS[1:], help="measure only an arm other than the usual one")
    options = parser.parse_args()
    about = {"date": options.date, "commit": commit(), "machine": machine()}
    if options.arm:
        rows = systematic_arm(Scene, SESSIONS[1:], list(range(1, options.seeds + 1)), options.arm)
        stem = options.results / f"hand_eye-{options.arm.lower().replace(' ', '_')}-{options.date}"
        _write(stem, {**about, "arm": options.arm, "systematic": rows}, arm_as_markdown)
        return
    record = {
        **about,
        "independent": independent_noise(options.seeds),
        "systematic": systematic_arm(Scene, SESSIONS, list(range(1, options.seeds + 1))),
        "odd": systematic_arm(OddScene, SESSIONS[1:2], list(range(1, options.seeds + 1))),
    }
    _write(options.results / f"hand_eye-{options.date}", record, as_markdown)


def _write(stem: Path, record: dict[str, Any], words: Callable[[dict[str, Any]], str]) -> None:
    text = words(record)
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
