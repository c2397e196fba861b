"""Accuracy of the registration against ground truth: all sources of poses, several scenes and resolutions."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import datetime
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from bench.machine import RESULTS, commit, machine
from drivers.meshes.mesh_file import read_mesh_file
from service.compute.camera_model import CameraModel
from service.compute.markers.image_files import detect_all
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import PipelineResult, register_images
from service.compute.poses.pose_files import read_camera_json, read_poses_csv, read_spheres_json
from service.compute.registration.accuracy import true_error_m
from service.compute.registration.problem import RegistrationSettings, residuals
from service.compute.registration.result import with_joint_pose_covariance
from service.compute.scene import PosedImages, ScanSpheres
from service.compute.sfm.estimate import SfmModel, SfmWorkspace, reconstruct
from service.compute.sfm.hybrid import HybridPoses, hybrid_poses
from service.compute.sfm.options import Effort, Mapper, options_for
from service.compute.surfaces.mesh_spheres import locate_spheres
from service.core.geometry import Array, Transform, align_points, apply, inverse
from tests.support.scenes.rendered_scene import CACHE, render_scene


@dataclass(frozen=True, slots=True)
class Capture:
    """A rendered capture, read back through the project's own readers, and its ground truth."""

    seed: int
    folder: Path
    files: list[Path]
    camera: CameraModel
    T_world_camera: Array  # (N, 4, 4) ground truth
    T_base_camera: Array  # (N, 4, 4) as the robot reports, with the true hand-eye
    stations: list[int]
    registration_m: Array  # (M, 3) sphere centres found in the scan's mesh
    control_m: Array
    true_registration_m: Array
    true_control_m: Array
    radius_m: float
    covariance_m2: Array  # (M, 3, 3) stated covariance of registration_m
    T_world_scan: Transform  # ground truth

    @property
    def names(self) -> list[str]:
        """File names of the images."""
        return [file.name for file in self.files]


def read_capture(seed: int, folder: Path) -> Capture:
    """Read what a user would have (images, camera, poses, scan), and the ground truth."""
    files = sorted((folder / "images").glob("*.jpg"))
    camera = read_camera_json(folder / "camera.json")
    spheres = read_spheres_json(folder / "spheres.json")
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    poses, flange = read_poses_csv(folder / "poses.csv"), read_poses_csv(folder / "robot_poses.csv")
    with (folder / "stations.csv").open(encoding="utf-8") as file:
        station = {row["image"]: row["station"] for row in csv.DictReader(file)}
    order = sorted(set(station.values()))
    T_flange_camera = np.array(truth["T_flange_camera"])
    scan = read_mesh_file(folder / "scan.ply", "mm")
    located = locate_spheres(scan.mesh.vertices_m, scan.mesh.faces, spheres.radius_m)
    found = np.array([s.centre_m for s in located])
    chosen = _nearest(found, spheres.centres_m)
    return Capture(
        seed=seed,
        folder=folder,
        files=files,
        camera=camera,
        T_world_camera=np.array([poses[file.name] for file in files]),
        T_base_camera=np.array([flange[file.name] @ T_flange_camera for file in files]),
        stations=[order.index(station[file.name]) for file in files],
        registration_m=found[chosen],
        control_m=found[_nearest(found, spheres.control_m)],
        true_registration_m=spheres.centres_m,
        true_control_m=spheres.control_m,
        radius_m=spheres.radius_m,
        covariance_m2=np.array([located[k].covariance for k in chosen]),
        T_world_scan=np.array(truth["T_world_scan"]),
    )


class Reconstructions:
    """SfM models of one capture, built on demand from shared features."""

    def __init__(self, capture: Capture, folder: Path, effort: Effort) -> None:
        self._capture, self._folder = capture, folder
        self._effort: Effort = effort
        self._made: dict[Mapper, SfmModel] = {}

    def model(self, mapper: Mapper) -> SfmModel:
        """The model of COLMAP's incremental mapper or of the global mapper."""
        if mapper not in self._made:
            c = self._capture
            files = dict(zip(c.names, c.files, strict=True))
            prior = dict(zip(c.names, c.T_world_camera, strict=True))  # only selects which images are matched
            options = options_for(self._effort, c.camera)
            self._made[mapper] = reconstruct(
                files, SfmWorkspace(self._folder, c.camera, options), mapper, T_world_camera_prior=prior
            )
        return self._made[mapper]


def measure(capture: Capture, sources: Sequence[str], effort: Effort, workers: int) -> dict[str, Any]:
    """Return one row of errors for each source of poses."""
    started = time.monotonic()
    outlines = detect_all(capture.files, capture.camera, workers=workers)
    detection_s = time.monotonic() - started
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory(prefix="orthocapture-bench-") as scratch:
        models = Reconstructions(capture, Path(scratch), effort)
        for source in sources:
            started = time.monotonic()
            rows[source] = SOURCE[source](capture, outlines, models)
            rows[source]["seconds"] = time.monotonic() - started
    return {
        "scene": capture.seed,
        "width": capture.camera.width,
        "images": len(capture.files),
        "effort": effort,
        "detection_s": detection_s,
        "scan_spheres_mm": 1e3 * _rms_distance(capture.registration_m, capture.true_registration_m),
        "sources": rows,
    }


Outlines = Sequence[Sequence[SphereOutline]]


def _from_truth(capture: Capture, outlines: Outlines, models: Reconstructions) -> dict[str, float]:
    del models
    solved = _registered(capture, outlines, capture.T_world_camera, pose_covariance="exact")
    return {**_errors(capture, outlines, solved), **_outline_errors(capture, outlines, solved)}


def _from_robot(capture: Capture, outlines: Outlines, models: Reconstructions) -> dict[str, float]:
    del models
    solved = _registered(capture, outlines, capture.T_base_camera, groups=capture.stations)
    return _errors(capture, outlines, solved)


def _from_sfm(mapper: Mapper) -> Callable[[Capture, Outlines, Reconstructions], dict[str, float]]:
    def solve(capture: Capture, outlines: Outlines, models: Reconstructions) -> dict[str, float]:
        model = models.model(mapper)
        index = [i for i, name in enumerate(capture.names) if name in model.T_world_camera]
        poses = np.array([model.T_world_camera[capture.names[i]] for i in index])
        solved = _registered(capture, [outlines[i] for i in index], poses, estimate_scale=True)
        stated = with_joint_pose_covariance(solved.registration, model.joint_pose_covariance())
        solved = dataclasses.replace(solved, registration=stated)
        rms_mm = _camera_rms_mm(poses, capture.T_world_camera[index])
        return {**_errors(capture, [outlines[i] for i in index], solved, index), "camera_rms_mm": rms_mm}

    return solve


def _from_hybrid(capture: Capture, outlines: Outlines, models: Reconstructions) -> dict[str, float]:
    model = models.model("incremental")
    index = [capture.names.index(name) for name in model.T_world_camera]
    mine = [outlines[i] for i in index]
    answer = hybrid_poses(
        PosedImages(
            np.array(list(model.T_world_camera.values())),
            capture.camera,
            groups=[capture.stations[i] for i in index],
            metric=False,
        ),
        model.tracks,
        mine,
        ScanSpheres(capture.registration_m, capture.radius_m, covariance_m2=capture.covariance_m2),
        T_base_camera=capture.T_base_camera[index],
    )
    solved = _registered(capture, mine, answer.T_world_camera)
    rms_mm = _camera_rms_mm(answer.T_world_camera, capture.T_world_camera[index])
    return {**_errors(capture, mine, solved, index, answer), "camera_rms_mm": rms_mm}


SOURCE: Mapping[str, Callable[[Capture, Outlines, Reconstructions], dict[str, float]]] = {
    "truth": _from_truth,
    "robot": _from_robot,
    "colmap": _from_sfm("incremental"),
    "glomap": _from_sfm("global"),
    "hybrid": _from_hybrid,
}


def _registered(
    capture: Capture,
    outlines: Outlines,
    poses: Array,
    *,
    groups: Sequence[int] | None = None,
    estimate_scale: bool = False,
    pose_covariance: Literal["estimate", "exact"] = "estimate",
) -> PipelineResult:
    return register_images(
        outlines,
        PosedImages(poses, capture.camera, groups=groups, metric=not estimate_scale),
        ScanSpheres(
            capture.registration_m, capture.radius_m, control_m=capture.control_m, covariance_m2=capture.covariance_m2
        ),
        RegistrationSettings(pose_covariance=pose_covariance),
    )


def _errors(
    capture: Capture,
    outlines: Outlines,
    solved: PipelineResult,
    index: Sequence[int] | None = None,
    adjusted: HybridPoses | None = None,
) -> dict[str, float]:
    """Errors of a registration, or of an adjustment that has already placed the scan."""
    at = list(range(len(capture.files))) if index is None else list(index)
    centre = capture.true_registration_m.mean(axis=0)
    T_scan_camera_true = inverse(capture.T_world_scan) @ capture.T_world_camera[at]
    T_scan_camera = solved.registration.T_scan_camera if adjusted is None else adjusted.T_scan_camera
    error_m = true_error_m(T_scan_camera, T_scan_camera_true, centre)
    sigma_m = solved.registration.sigma_at_m(centre) if adjusted is None else adjusted.sigma_at_m(centre)
    assert solved.evaluation is not None
    wrong = 0
    for k, (assignment, control) in enumerate(zip(solved.assignments, solved.control_assignments, strict=True)):
        for markers, centres in ((assignment.markers, capture.registration_m), (control.markers, capture.control_m)):
            for outline, marker in markers.items():
                c = apply(inverse(T_scan_camera_true[k]), centres[marker])
                cone = outlines[k][outline].cone
                off_rad = np.arccos(np.clip(cone.axis @ c / np.linalg.norm(c), -1, 1))
                wrong += bool(off_rad > 0.3 * cone.half_angle_rad)
    return {
        "true_error_mm": 1e3 * error_m,
        "sigma_mm": 1e3 * sigma_m,
        "normalised": error_m / sigma_m,
        "mean_radial_error_mm": solved.evaluation.mean_radial_error_mm,
        "mean_reprojection_error_px": solved.evaluation.mean_reprojection_error_px,
        "rms_px": solved.registration.rms_px,
        "chi2_reduced": solved.registration.chi2_reduced,
        "excluded_outlines": float(len(solved.registration.excluded)),
        "wrong": float(wrong),
    }


def _outline_errors(capture: Capture, outlines: Outlines, solved: PipelineResult) -> dict[str, float]:
    """Statistics of the signed distances of the outline points from the true outlines (px, positive outside)."""
    f = 0.5 * (capture.camera.fx + capture.camera.fy)
    distances: list[Array] = []
    for i, T in enumerate(inverse(capture.T_world_scan) @ capture.T_world_camera):
        pairs = [(j, capture.true_registration_m[m]) for j, m in solved.assignments[i].markers.items()]
        pairs += [(j, capture.true_control_m[m]) for j, m in solved.control_assignments[i].markers.items()]
        for j, centre in pairs:
            points = np.column_stack([outlines[i][j].points, np.ones(len(outlines[i][j].points))])
            c = apply(inverse(T), centre)
            distances.append(f * residuals(points, np.broadcast_to(c, points.shape), capture.radius_m, "sampson"))
    every = np.concatenate(distances)
    return {
        "outline_rms_px": float(np.sqrt(np.mean(every**2))),
        "outline_bias_px": float(np.mean(every)),
        "outlines": float(len(distances)),
        "outlines_possible": float(len(capture.files) * (len(capture.registration_m) + len(capture.control_m))),
    }


def _camera_rms_mm(estimated: Array, true: Array) -> float:
    T, scale = align_points(true[:, :3, 3], estimated[:, :3, 3], with_scale=True)
    placed = apply(T, scale * estimated[:, :3, 3])
    return 1e3 * _rms_distance(placed, true[:, :3, 3])


def _rms_distance(a: Array, b: Array) -> float:
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


def _nearest(found: Array, wanted: Array) -> list[int]:
    return [int(np.argmin(np.linalg.norm(found - w, axis=1))) for w in wanted]


def summarise(captures: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Median and worst value of every figure, by source of the poses."""
    by_source: dict[str, list[Mapping[str, float]]] = {}
    for capture in captures:
        for source, row in capture["sources"].items():
            by_source.setdefault(source, []).append(row)
    return {
        source: {
            key: {
                "median": statistics.median(row[key] for row in rows),
                "worst": max((row[key] for row in rows), key=abs),
            }
            for key in rows[0]
        }
        for source, rows in by_source.items()
    }


_COLUMNS = (
    ("true_error_mm", "true error (mm)", 3),
    ("sigma_mm", "stated sigma (mm)", 3),
    ("mean_radial_error_mm", "radial error (mm)", 3),
    ("mean_reprojection_error_px", "reprojection error (px)", 2),
    ("chi2_reduced", "chi² reduced", 2),
    ("wrong", "wrong or false", 0),
    ("camera_rms_mm", "cameras rms (mm)", 3),
    ("outline_rms_px", "outline rms (px)", 3),
    ("outline_bias_px", "outline bias (px)", 3),
)


def as_markdown(record: Mapping[str, Any]) -> str:
    """Format the record as Markdown."""
    computer = record["machine"]
    lines = [
        f"# Accuracy on simulated scenes, {record['date']}",
        "",
        f"Commit {record['commit']}; {computer['processor']}, {computer['cores']} cores, {computer['memory_gb']} GB, "
        f"{computer['system']}, Python {computer['python']}.",
        "",
        "True error: displacement at the centre of the registration spheres against the simulator's truth. The",
        "spheres are located in the simulated scan. Robot: the arm's reported poses with the true hand-eye. Sigma:",
        "3D, at the same point, so that (error/sigma)² is 1 in the mean. Radial and reprojection error: control",
        "spheres. Wrong or false: outlines that are not the sphere they were taken for.",
    ]
    for width in dict.fromkeys(capture["width"] for capture in record["captures"]):
        here = [capture for capture in record["captures"] if capture["width"] == width]
        images = sorted({capture["images"] for capture in here})
        lines += [
            "",
            f"## {width} px wide, {', '.join(map(str, images))} images, {len(here)} scenes: median / worst",
            "",
        ]
        headings = [heading for _, heading, _ in _COLUMNS] + ["within 3 sigma", "mean (error/sigma)²"]
        lines.append(f"| poses | {' | '.join(headings)} |")
        lines.append("|---|" + "---:|" * len(headings))
        for source, row in summarise(here).items():
            cells = [
                f"{row[key]['median']:.{digits}f} / {row[key]['worst']:.{digits}f}" if key in row else ""
                for key, _, digits in _COLUMNS
            ]
            normalised = [
                capture["sources"][source]["normalised"] for capture in here if source in capture["sources"]
            ]
            cells.append(f"{sum(n <= 3 for n in normalised)} of {len(normalised)}")
            cells.append(f"{statistics.fmean(n**2 for n in normalised):.2f}")
            lines.append(f"| {source} | {' | '.join(cells)} |")
        lines += ["", "| scene | poses | true error (mm) | sigma (mm) | radial (mm) |", "|---:|---|---:|---:|---:|"]
        for capture in here:
            for source, row in capture["sources"].items():
                lines.append(
                    f"| {capture['scene']} | {source} | {row['true_error_mm']:.3f} | {row['sigma_mm']:.3f} | "
                    f"{row['mean_radial_error_mm']:.3f} |"
                )
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=list(range(1, 11)), metavar="SEED")
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--sources", nargs="+", default=list(SOURCE), choices=list(SOURCE))
    parser.add_argument(
        "--effort", default="normal", choices=get_args(Effort), help="effort of structure from motion"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat())
    options = parser.parse_args()
    options.results.mkdir(parents=True, exist_ok=True)
    stem = options.results / f"accuracy-{options.width}-{options.date}"
    captures: list[dict[str, Any]] = []
    for seed in options.scenes:
        folder = render_scene(seed, options.width, options.views, cache=options.cache, workers=options.workers)
        captures.append(measure(read_capture(seed, folder), options.sources, options.effort, options.workers))
        rows = captures[-1]["sources"].items()
        print(seed, {source: round(row["true_error_mm"], 4) for source, row in rows}, file=sys.stderr, flush=True)
        record = {"date": options.date, "commit": commit(), "machine": machine(), "captures": captures}
        stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        stem.with_suffix(".md").write_text(as_markdown(record), encoding="utf-8")
    print(stem.with_suffix(".md").read_text(encoding="utf-8"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
