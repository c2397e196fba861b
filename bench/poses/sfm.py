"""Camera poses of every source against ground truth (robot, triangulated, mapped, hybrid) on rendered scenes."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.machine import RESULTS, commit, machine
from bench.registration.accuracy import Capture, read_capture
from service.compute.markers.image_files import detect_all
from service.compute.pipeline import register_images
from service.compute.registration.accuracy import true_error_m
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.sfm.estimate import SfmModel, SfmWorkspace, reconstruct
from service.compute.sfm.hybrid import hybrid_poses
from service.compute.sfm.options import Effort, Mapper, options_for
from service.core.geometry import Array, align_points, apply, inverse
from tests.support.scenes.rendered_scene import CACHE, render_scene

COLUMNS = (
    ("camera_rms_mm", "camera positions, aligned (mm)"),
    ("rotation_deg", "rotation (°)"),
    ("true_error_mm", "true registration error (mm)"),
    ("predicted_error_mm", "predicted (mm)"),
    ("chi2", "normalised chi²"),
    ("map_cpu_s", "CPU-s of mapping"),
    ("cpu_s", "CPU-s of registration"),
)


def measure(capture: Capture, effort: Effort, workspace: Path) -> dict[str, dict[str, float]]:
    """Return one row for each source of poses. Rotation, true error and chi² refer to T_scan_camera.

    chi² is that of the camera poses given their stated covariance, per degree of freedom.
    """
    truth = np.array([inverse(capture.T_world_scan) @ T for T in capture.T_world_camera])
    centre_m = capture.registration_m.mean(axis=0)
    outlines = detect_all(capture.files, capture.camera)
    rows: dict[str, dict[str, float]] = {}
    solved = register_images(
        outlines,
        PosedImages(capture.T_base_camera, capture.camera, groups=capture.stations),
        ScanSpheres(capture.registration_m, capture.radius_m),
    ).registration
    rows["robot"] = {
        **_errors(solved.T_scan_camera, truth, centre_m), "predicted_error_mm": 1e3 * solved.sigma_at_m(centre_m)
    }  # fmt: skip
    models: dict[str, SfmModel] = {}
    mappers: dict[str, Mapper] = {"triangulated": "triangulated", "colmap": "incremental", "glomap": "global"}
    options = options_for(effort, capture.camera)
    for source, mapper in mappers.items():
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        models[source] = reconstruct(
            dict(zip(capture.names, capture.files, strict=True)),
            SfmWorkspace(workspace, capture.camera, options),
            mapper,
            # The registered robot poses only select image pairs and initialise the triangulation.
            T_world_camera_prior=dict(zip(capture.names, solved.T_scan_camera, strict=True)),
        )
        spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        rows[source] = _timed(lambda m=models[source]: _from_model(capture, m, outlines, truth))
        rows[source] |= {"images": float(models[source].n_registered)}
        if set(models[source].seconds) == {"map"}:  # features and matches existed already
            rows[source] |= {"map_cpu_s": spent}
    rows["hybrid"] = _timed(lambda: _hybrid(capture, models["colmap"], outlines, truth))
    return rows


def _thinned(capture: Capture, every: int) -> Capture:
    return dataclasses.replace(
        capture,
        files=capture.files[::every],
        T_world_camera=capture.T_world_camera[::every],
        T_base_camera=capture.T_base_camera[::every],
        stations=capture.stations[::every],
    )


def _timed(work: Callable[[], dict[str, float]]) -> dict[str, float]:
    started = time.process_time()
    return {**work(), "cpu_s": time.process_time() - started}


def _from_model(capture: Capture, model: SfmModel, outlines: Sequence[Any], truth: Array) -> dict[str, float]:
    index = [capture.names.index(name) for name in model.T_world_camera]
    poses = np.array(list(model.T_world_camera.values()))
    solved = register_images(
        [outlines[i] for i in index],
        PosedImages(poses, capture.camera, metric=False),
        ScanSpheres(capture.registration_m, capture.radius_m),
    ).registration
    centre_m = capture.registration_m.mean(axis=0)
    T, s = align_points(poses[:, :3, 3], truth[index, :3, 3], with_scale=True)
    expected = np.array([T @ _scaled(P, s) for P in truth[index]])
    error, C = _increments(poses, expected), model.pose_covariance()
    return {
        **_errors(solved.T_scan_camera, truth[index], centre_m),
        "camera_rms_mm": 1e3 * _aligned_rms_m(poses, truth[index], with_scale=True),
        "predicted_error_mm": 1e3 * solved.sigma_at_m(centre_m),
        "chi2": float(np.mean([e @ np.linalg.solve(K, e) / 6 for e, K in zip(error, C, strict=True)])),
    }


def _hybrid(capture: Capture, model: SfmModel, outlines: Sequence[Any], truth: Array) -> dict[str, float]:
    index = [capture.names.index(name) for name in model.T_world_camera]
    answer = hybrid_poses(
        PosedImages(
            np.array(list(model.T_world_camera.values())),
            capture.camera,
            groups=[capture.stations[i] for i in index],
            metric=False,
        ),
        model.tracks,
        [outlines[i] for i in index],
        ScanSpheres(capture.registration_m, capture.radius_m),
        T_base_camera=capture.T_base_camera[index],
    )
    error = _increments(answer.T_scan_camera, truth[index]).ravel()
    C = answer.covariance[: error.size, : error.size]
    return {
        **_errors(answer.T_scan_camera, truth[index], capture.registration_m.mean(axis=0)),
        "predicted_error_mm": 1e3 * answer.sigma_at_m(answer.centre_scan_m),
        "chi2": float(error @ np.linalg.solve(C, error) / error.size),
        "sigma_track_px": answer.sigma_track_px,
        "sigma_robot_mm": 1e3 * (answer.sigma_robot_m or 0.0),
        "sigma_robot_deg": float(np.degrees(answer.sigma_robot_rad or 0.0)),
    }


def _errors(T_scan_camera: Array, truth: Array, centre_m: Array) -> dict[str, float]:
    turns = _increments(T_scan_camera, truth)[:, 3:]
    return {
        "camera_rms_mm": 1e3 * _aligned_rms_m(T_scan_camera, truth, with_scale=False),
        "rotation_deg": float(np.degrees(np.sqrt(np.mean(np.sum(turns**2, axis=1))))),
        "true_error_mm": 1e3 * true_error_m(T_scan_camera, truth, centre_m),
    }


def _aligned_rms_m(poses: Array, truth: Array, *, with_scale: bool) -> float:
    a, b = truth[:, :3, 3], poses[:, :3, 3]
    T, s = align_points(a, b, with_scale=with_scale)
    return float(np.sqrt(np.mean(np.sum((a - apply(T, s * b)) ** 2, axis=1))))


def _increments(estimated: Array, true: Array) -> Array:
    turns = Rotation.from_matrix(estimated[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)).as_rotvec()
    return np.hstack([estimated[:, :3, 3] - true[:, :3, 3], turns])


def _scaled(T: Array, s: float) -> Array:
    out = T.copy()
    out[:3, 3] *= s
    return out


def as_markdown(record: Mapping[str, Any]) -> str:
    """Format the record as Markdown."""
    lines = [
        f"# Camera poses, {record['date']}",
        "",
        f"Commit {record['commit']}; effort {record['effort']}, {record['views']} images {record['width']} px wide, "
        "calibrated camera held. Camera positions of triangulated, colmap and glomap after a similarity, of the "
        "others after a rigid alignment. CPU-s of mapping: of one source alone, features and matches being there.",
        "",
        f"| scene | poses | {' | '.join(heading for _, heading in COLUMNS)} |",
        "|---:|---|" + "---:|" * len(COLUMNS),
    ]
    for scene in record["scenes"]:
        for source, row in scene["sources"].items():
            figures = " | ".join(f"{row[key]:.4g}" if key in row else "" for key, _ in COLUMNS)
            lines.append(f"| {scene['scene']} | {source} | {figures} |")
    for source in record["scenes"][0]["sources"]:
        rows = [scene["sources"][source] for scene in record["scenes"]]
        medians = [
            f"{statistics.median(row[key] for row in rows):.4g}" if key in rows[0] else "" for key, _ in COLUMNS
        ]
        lines.append(f"| median | {source} | {' | '.join(medians)} |")
    return "\n".join(lines) + "\n"


def main(words: Sequence[str] | None = None) -> int:
    """Measure the named scenes; print and write the table after each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1, 2, 3], metavar="SEED")
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--every", type=int, default=1, help="take every n-th of the views")
    parser.add_argument("--effort", choices=("quick", "normal", "quality"), default="quality")
    parser.add_argument("--workspaces", type=Path, help="folder in which to cache features and matches")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    record: dict[str, Any] = {
        "date": options.date,
        "commit": commit(),
        "machine": machine(),
        "effort": options.effort,
        "width": options.width,
        "views": -(-options.views // options.every),
        "scenes": [],
    }
    options.results.mkdir(parents=True, exist_ok=True)
    text = ""
    with tempfile.TemporaryDirectory(prefix="orthocapture-bench-") as temporary:
        for seed in options.scenes:
            folder = render_scene(seed, options.width, options.views, cache=CACHE)
            kept = (options.workspaces or Path(temporary)) / f"{folder.name}_{options.effort}"
            sources = measure(_thinned(read_capture(seed, folder), options.every), options.effort, kept)
            record["scenes"].append({"scene": seed, "sources": sources})
            stem = options.results / f"sfm-{options.date}-{options.effort}"
            stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
            text = as_markdown(record)
            stem.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
