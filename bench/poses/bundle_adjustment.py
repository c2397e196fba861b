"""Our bundle adjustment against COLMAP's (Ceres) on the same tracks, spheres and robot poses, with the truth known.

Simulated geometry: tracks with Gaussian noise and false matches, outlines of spheres, a robot with independent noise.
Ways:

- `pycolmap`: tracks alone by pycolmap.bundle_adjustment, then scale and pose of the scan from the spheres.
- `spheres`: tracks and spheres in one adjustment of ours, without the robot.
- `hybrid`: tracks, spheres and robot poses in one adjustment of ours.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from bench.machine import RESULTS, commit, machine
from service.compute.pipeline import register_images
from service.compute.registration.identity import identify
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.solve import register
from service.compute.scene import PosedImages
from service.compute.sfm.colmap import from_colmap_pose, to_colmap_camera, to_colmap_pixels, to_colmap_pose
from service.compute.sfm.hybrid import HybridOptions, HybridPoses, hybrid_poses
from service.core.geometry import Array, align_points, apply
from tests.support.scenes.sphere_images import REGISTRATION
from tests.support.scenes.tracked_scene import TrackedScene, pose_errors, tracked_scene

# Images x points, of which seven images of ten see each; 40x30 is a scene with next to no texture.
SIZES = ("8x300", "40x30", "40x1000", "108x1500")
TRACK_PX, OUTLINE_PX, ROBOT_M, ROBOT_RAD, FALSE = 0.3, 0.1, 5e-4, 1e-3, 0.02
CAUCHY = 2.4  # in sigmas of a track, as in ours
_SPHERES = HybridOptions(sphere_sigma_m=1e-6)  # those of the simulation are where the list says


def adjusted_by_colmap(made: TrackedScene, track_px: float = TRACK_PX) -> tuple[Array, float]:
    """T_world_camera (N, 4, 4) in the tracks' own frame and unit, and the CPU seconds that Ceres took."""
    tracks = made.tracks
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(to_colmap_camera(made.camera))
    mine = [np.nonzero(tracks.image == k)[0] for k in range(len(made.poses))]
    feature = np.empty(len(tracks.image), dtype=np.int64)
    for k, rows in enumerate(mine):
        feature[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=f"{k}.jpg", keypoints=to_colmap_pixels(tracks.pixels[rows]), camera_id=1, image_id=k + 1
        )
        model.add_image_with_trivial_frame(image, to_colmap_pose(made.poses[k]))
    for p, point in enumerate(tracks.points):
        rows = np.nonzero(tracks.point == p)[0]
        elements = [pycolmap.TrackElement(int(tracks.image[o]) + 1, int(feature[o])) for o in rows]
        model.add_point3D(point, pycolmap.Track(elements))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = CAUCHY * track_px
    solver = options.ceres.solver_options
    solver.num_threads = 1
    solver.function_tolerance, solver.gradient_tolerance = 1e-9, 1e-12
    begun = time.process_time()
    pycolmap.bundle_adjustment(model, options)
    seconds = time.process_time() - begun
    return np.array([from_colmap_pose(model.image(k + 1).cam_from_world()) for k in range(len(made.poses))]), seconds


def errors(T_scan_camera: Array, made: TrackedScene) -> dict[str, float]:
    """Of the poses in the scan's frame: all together, and what is left once they are laid over the true ones."""
    off = pose_errors(T_scan_camera, made.T_scan_camera)
    T, scale = align_points(made.T_scan_camera[:, :3, 3], T_scan_camera[:, :3, 3], with_scale=True)
    left = apply(T, scale * T_scan_camera[:, :3, 3]) - made.T_scan_camera[:, :3, 3]
    return {
        "position_mm": 1e3 * float(np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1)))),
        "rotation_mrad": 1e3 * float(np.sqrt(np.mean(np.sum(off[:, 3:] ** 2, axis=1)))),
        "shape_mm": 1e3 * float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
    }


def honest(answer: HybridPoses, made: TrackedScene) -> float:
    """Chi² of all poses together by their joint covariance, for each number: 1 where it says what they err."""
    off = pose_errors(answer.T_scan_camera, made.T_scan_camera).ravel()
    return float(off @ np.linalg.solve(answer.covariance[: off.size, : off.size], off)) / off.size


def by_colmap(made: TrackedScene) -> dict[str, float]:
    """Two steps: COLMAP's adjustment of the tracks, then the registration by the spheres."""
    poses, seconds = adjusted_by_colmap(made)
    solved = register_images(made.outlines, PosedImages(poses, made.camera, metric=False), REGISTRATION).registration
    return {**errors(solved.T_scan_camera, made), "adjustment_s": seconds}


def start_s(made: TrackedScene) -> float:
    """CPU seconds of what `hybrid_poses` does before its adjustment: identity and a first registration."""
    images = PosedImages(made.poses, made.camera, metric=False)
    begun = time.process_time()
    assignments = identify(made.outlines, images, REGISTRATION)
    register(made.outlines, assignments, images, REGISTRATION, RegistrationSettings(pose_covariance="exact"))
    return time.process_time() - begun


def adjusted_by_ours(made: TrackedScene, *, robot: bool) -> HybridPoses:
    """One adjustment of tracks and spheres, and of the robot's poses where these take part."""
    images = PosedImages(made.poses, made.camera, groups=made.groups if robot else None, metric=False)
    T_base_camera = made.T_base_camera if robot else None
    return hybrid_poses(
        images, made.tracks, made.outlines, REGISTRATION, T_base_camera=T_base_camera, options=_SPHERES
    )


def by_ours(made: TrackedScene, *, robot: bool) -> dict[str, float]:
    """One adjustment."""
    before_s, begun = start_s(made), time.process_time()
    answer = adjusted_by_ours(made, robot=robot)
    seconds = time.process_time() - begun - before_s
    row = {**errors(answer.T_scan_camera, made), "chi2": honest(answer, made), "adjustment_s": seconds}
    row["track_px"] = answer.sigma_track_px
    if answer.sigma_robot_m is not None and answer.sigma_robot_rad is not None:
        row |= {"robot_mm": 1e3 * answer.sigma_robot_m, "robot_mrad": 1e3 * answer.sigma_robot_rad}
    return row


def same_minimum_um(made: TrackedScene) -> float:
    """RMS distance, in micrometres, of COLMAP's camera positions and ours, laid over one another: of tracks alone.

    Our outlines count a millionth here, so that they give a frame and a scale and nothing else.
    """
    faint = [
        tuple(dataclasses.replace(o, cone_covariance=1e6 * o.cone_covariance) for o in found)
        for found in made.outlines
    ]
    answer = adjusted_by_ours(dataclasses.replace(made, outlines=faint), robot=False)
    poses, _ = adjusted_by_colmap(made, answer.sigma_track_px)
    ours = answer.T_scan_camera
    T, scale = align_points(ours[:, :3, 3], poses[:, :3, 3], with_scale=True)
    apart = apply(T, scale * poses[:, :3, 3]) - ours[:, :3, 3]
    return 1e6 * float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


WAYS: dict[str, Callable[[TrackedScene], dict[str, float]]] = {
    "pycolmap": by_colmap,
    "spheres": lambda made: by_ours(made, robot=False),
    "hybrid": lambda made: by_ours(made, robot=True),
}


def measured(images: int, points: int, seeds: int) -> list[dict[str, Any]]:
    """Medians over the seeds, one row a way."""
    found: dict[str, list[dict[str, float]]] = {way: [] for way in WAYS}
    apart: list[float] = []
    observations = 0
    for seed in range(seeds):
        made = tracked_scene(
            seed, images=images, points=points, track_px=TRACK_PX, outline_px=OUTLINE_PX, robot_m=ROBOT_M,
            robot_rad=ROBOT_RAD, outliers=FALSE,
        )  # fmt: skip
        observations = len(made.tracks.image)
        for way, solve in WAYS.items():
            found[way].append(solve(made))
            print(f"{images} images, seed {seed}, {way}: {found[way][-1]}", flush=True)
        apart.append(same_minimum_um(made))
    return [
        {
            "images": images,
            "observations": observations,
            "seeds": seeds,
            "way": way,
            **{name: float(np.median([row[name] for row in rows])) for name in rows[0]},
            **({"apart_um": float(np.median(apart))} if way == "spheres" else {}),
        }
        for way, rows in found.items()
    ]


COLUMNS = {
    "images": ("images", "{:d}"), "observations": ("observations", "{:d}"), "seeds": ("seeds", "{:d}"),
    "way": ("way", "{}"),
    "position_mm": ("position (mm)", "{:.4f}"), "rotation_mrad": ("rotation (mrad)", "{:.4f}"),
    "shape_mm": ("position, laid over the truth (mm)", "{:.4f}"), "chi2": ("chi² of the poses", "{:.2f}"),
    "track_px": ("σ of tracks (px)", "{:.3f}"), "robot_mm": ("σ of the robot (mm)", "{:.3f}"),
    "robot_mrad": ("(mrad)", "{:.3f}"), "apart_um": ("tracks alone, from COLMAP's (µm)", "{:.2f}"),
    "adjustment_s": ("adjustment (CPU s)", "{:.2f}"),
}  # fmt: skip


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table with what it shows."""
    head = "| " + " | ".join(title for title, _ in COLUMNS.values()) + " |"
    lines = [
        "| " + " | ".join(form.format(row[name]) if name in row else "" for name, (_, form) in COLUMNS.items()) + " |"
        for row in rows
    ]
    here = machine()
    return (
        f"""# Bundle adjustment, {datetime.now(UTC):%Y-%m-%d}

Commit {commit()}. {here["processor"]}, {here["cores"]} cores, shared with other work.
One thread, CPU seconds. Medians over the seeds.

Tracks with {TRACK_PX} px noise for each coordinate and {100 * FALSE:.0f} % false matches, outlines
with {OUTLINE_PX} px, a robot with {1e3 * ROBOT_M:.1f} mm and {1e3 * ROBOT_RAD:.0f} mrad for each axis.
The camera is held.

- `pycolmap` adjusts the tracks and is registered by the spheres afterwards.
- `spheres` and `hybrid` are one adjustment of ours, `hybrid` with the robot's poses.

Errors are of T_scan_camera against the truth, 3D RMS. `chi² of the poses` is that of all poses by their stated joint
covariance, for each number. The sigmas are estimated from the data.

{head}
|{"---|" * len(COLUMNS)}
"""
        + "\n".join(lines)
        + "\n"
    )


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--sizes", nargs="+", default=SIZES, metavar="IMAGESxPOINTS")
    parser.add_argument("--append", action="store_true", help="keep the rows that are in today's results")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    name = f"bundle_adjustment-{datetime.now(UTC):%Y-%m-%d}"
    before = options.out / f"{name}.json"
    rows: list[dict[str, Any]] = json.loads(before.read_text())["rows"] if options.append else []
    for size in options.sizes:
        images, points = map(int, size.split("x"))
        rows += measured(images, points, options.seeds)
        rows.sort(key=lambda row: (row["images"], row["observations"]))
        document = {"machine": machine(), "commit": commit(), "rows": rows}
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
        (options.out / f"{name}.md").write_text(markdown(rows), encoding="utf-8")
    print(markdown(rows))


if __name__ == "__main__":
    main()
