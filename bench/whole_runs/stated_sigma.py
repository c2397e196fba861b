"""Are the stated sigmas of whole runs right? Registrations with corrected robot poses of kept runs, computed again.

Runs are kept by `--keep` of the other benches here, or by `orthocapture demo`. Of each run: the registration as this
revision computes it from the recorded outlines, against the simulator's record; the calibration of the camera; and by
how much light displaces single spheres, the true camera given.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.machine import RESULTS, commit, machine
from service.cli.demo import true_cameras
from service.computations.conversion import camera_used, lens_covariance
from service.computations.inputs import read_outlines, robot_camera_poses
from service.computations.registration import REGISTER, RegisterArguments
from service.compute.camera_model import CameraModel
from service.compute.pipeline import register_images
from service.compute.registration.problem import RegistrationSettings
from service.compute.registration.result import camera_errors
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, apply, inverse, skew
from service.core.jobs import jobs_of
from service.core.units import mm
from service.dataset.summary import RunSummary, summarise
from service.run_start import recorded_run
from service.store.store import Store

_LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_MOST_OFF_PX = 2.0  # of an outline's axis from where its sphere is


def measured(folder: Path, most_images: int) -> dict[str, Any]:
    """The figures of one kept run, whose `rig/` holds the truth and `data/` the record."""
    truth = json.loads((folder / "rig" / "truth.json").read_text(encoding="utf-8"))
    with Store.open(folder / "data", create=False) as store:
        run = store.find_run("latest")
        summary = summarise(store, run, recorded_run(store, run)[0])
        cameras = true_cameras(summary, folder / "rig" / "truth_exposures.jsonl")
        arguments = _arguments(summary)
        chosen = np.unique(np.linspace(0, len(arguments.images) - 1, most_images).round().astype(int))
        images = tuple(arguments.images[i] for i in chosen if arguments.images[i].viewpoint in cameras)
        arguments = arguments.model_copy(update={"images": images})
        outlines = json.loads(store.artefact_path(arguments.outlines).read_bytes())
    true = {image.viewpoint: cameras[image.viewpoint] for image in images}
    lens = CameraModel(
        truth["intrinsics"]["width"], truth["intrinsics"]["height"], *(truth["intrinsics"][name] for name in _LENS)
    )
    return {
        "run": folder.name,
        "scene": truth["scene"],
        "images": len(images),
        "width": lens.width,
        **_registered(arguments, outlines, true, np.array(truth["scans"][-1]["T_world_scan"])),
        "lens_chi2": _lens_chi2(arguments, truth["intrinsics"]),
        **_spheres(outlines, camera_used(arguments), lens, true, np.array(truth["registration_m"])),
    }


def _arguments(summary: RunSummary) -> RegisterArguments:
    """Of the run's first registration with corrected robot poses: that of the scan."""
    jobs = jobs_of(summary.state)
    for one in jobs.values():
        if one.kind == REGISTER.name and REGISTER.read_answer(one.result).poses == "robot_corrected":
            return REGISTER.read_arguments(one.arguments, jobs)
    raise ValueError(f"the run {summary.run_id} has no registration with corrected robot poses")


def _registered(
    arguments: RegisterArguments, outlines: Mapping[str, Any], true: Mapping[str, Array], T_world_scan: Array
) -> dict[str, float]:
    images, camera = arguments.images, camera_used(arguments)
    stations = sorted({image.station for image in images})
    posed = PosedImages(
        robot_camera_poses(arguments, images), camera, groups=[stations.index(image.station) for image in images]
    )
    spheres = ScanSpheres(
        np.array(arguments.spheres_m), arguments.radius_m, covariance_m2=np.array(arguments.sphere_covariance_m2)
    )
    found = read_outlines(lambda _: outlines, arguments.outlines, images, camera)
    covariance = lens_covariance(arguments.intrinsics_covariance)
    settings = RegistrationSettings(intrinsics_covariance=covariance)
    solved = register_images(found, posed, spheres, check=False)
    judged = register_images(found, posed, spheres, settings, assignments=solved.assignments, check=False)
    poses = solved.registration.T_scan_camera_refined
    joint = camera_errors(judged.registration, refined=True)
    T_scan_camera = np.array([inverse(T_world_scan) @ true[image.viewpoint] for image in images])
    errors = np.array([_pose_error(T, T_true) for T, T_true in zip(poses, T_scan_camera, strict=True)])
    centre_m = np.array(arguments.spheres_m).mean(axis=0)
    out: dict[str, float] = {}
    for name, by_poses in (("seen", _as_seen(poses, centre_m)), ("aligned", _aligned(poses, centre_m))):
        out[f"{name}_error_mm"] = mm(float(np.linalg.norm(by_poses @ errors.ravel())))
        out[f"{name}_sigma_mm"] = mm(float(np.sqrt(np.trace(by_poses @ joint @ by_poses.T))))
    sigmas = np.sqrt(np.diag(joint)).reshape(-1, 6)
    out["position_error_mm"] = mm(float(np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))))
    out["position_sigma_mm"] = mm(float(np.sqrt(np.mean(np.sum(sigmas[:, :3] ** 2, axis=1)))))
    blocks = [joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(images))]
    out["pose_chi2"] = float(np.mean([e @ np.linalg.solve(C, e) / 6 for e, C in zip(errors, blocks, strict=True)]))
    return out


def _pose_error(T: Array, T_true: Array) -> Array:
    """(6,) position and rotation vector of a pose's error, in the axes of the scan."""
    return np.concatenate([T[:3, 3] - T_true[:3, 3], Rotation.from_matrix(T[:3, :3] @ T_true[:3, :3].T).as_rotvec()])


def _as_seen(poses: Array, point_m: Array) -> Array:
    """(3, 6 N) how errors of the poses move a point as the cameras see it, averaged over them."""
    parts = [np.hstack([-np.eye(3), skew(point_m - T[:3, 3])]) for T in poses]
    return np.hstack(parts) / len(poses)


def _aligned(poses: Array, point_m: Array) -> Array:
    """(3, 6 N) how they move it after a rigid alignment of the cameras' positions, as `true_error_m` has it."""
    places = poses[:, :3, 3]
    middle = places.mean(axis=0)
    arms = places - middle
    inertia = np.sum([(arm @ arm) * np.eye(3) - np.outer(arm, arm) for arm in arms], axis=0)
    turn = skew(point_m - middle) @ np.linalg.inv(inertia)
    parts = [np.hstack([-np.eye(3) / len(poses) + turn @ skew(arm), np.zeros((3, 3))]) for arm in arms]
    return np.hstack(parts)


def _lens_chi2(arguments: RegisterArguments, truth: Mapping[str, float]) -> float | None:
    """The calibration's squared error in the metric of its covariance, per parameter."""
    covariance = lens_covariance(arguments.intrinsics_covariance)
    if covariance is None:
        return None
    camera = camera_used(arguments)
    error = np.array([getattr(camera, name) - truth[name] for name in _LENS])
    return float(error @ np.linalg.solve(covariance, error)) / len(_LENS)


def _spheres(
    outlines: Mapping[str, Any],
    camera: CameraModel,
    lens: CameraModel,
    true: Mapping[str, Array],
    centres_m: Array,
) -> dict[str, float]:
    """By how much the images place single spheres off, given the true cameras; per coordinate, as rms and in px."""
    rows: list[list[tuple[Array, Array]]] = [[] for _ in centres_m]
    depths_m: list[float] = []
    for name, T_world_camera in true.items():
        T_camera_world = inverse(T_world_camera)
        seen_m = apply(T_camera_world, centres_m)
        expected = seen_m[:, :2] / seen_m[:, 2:]
        for record in outlines[name]:
            axis = np.array(record["axis"])
            place = lens.normalise(camera.project(axis[None]))[0]
            k = int(np.argmin(np.linalg.norm(expected - place, axis=1)))
            off = lens.fx * (place - expected[k])
            if np.linalg.norm(off) < _MOST_OFF_PX:
                x, y, z = seen_m[k]
                by_place = np.array([[1, 0, -x / z], [0, 1, -y / z]]) @ T_camera_world[:3, :3]
                rows[k].append((lens.fx / z * by_place, off))
                depths_m.append(float(z))
    moved: list[Array] = []
    noise: list[float] = []
    for mine in rows:
        J, off = np.vstack([j for j, _ in mine]), np.concatenate([o for _, o in mine])
        step, *_ = np.linalg.lstsq(J, off)
        moved.append(np.asarray(step, dtype=np.float64))
        noise.append(float(np.trace(np.linalg.inv(J.T @ J)) * np.var(off - J @ step)) / 3)
    unit_m = float(np.mean(depths_m)) / lens.fx
    spread = float(np.mean(np.var(moved, axis=0, ddof=1)))
    return {
        "spheres_moved_px": float(np.sqrt(spread)) / unit_m,
        "of_which_noise_px": float(np.sqrt(np.mean(noise))) / unit_m,
    }


def as_markdown(record: Mapping[str, Any]) -> str:
    """The record as a page."""
    lines = [
        f"# Stated sigmas of whole runs, {record['date']}",
        "",
        f"Commit {record['commit']}. Corrected "
        "robot poses, refined by the outlines. Seen: displacement of the spheres' centre as the cameras see it, "
        "averaged over them, which is what the stated sigma is of. Aligned: after a rigid alignment of the cameras' "
        "positions, as the true error of a simulated run has it. Error / sigma in mm, 3D; chi² per degree.",
        "",
        "| run | scene | px | images | seen | aligned | positions | chi² of poses | chi² of the lens | spheres moved "
        "(noise), px |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in record["runs"]:
        pairs = [f"{row[f'{n}_error_mm']:.3f} / {row[f'{n}_sigma_mm']:.3f}" for n in ("seen", "aligned", "position")]
        lens = "–" if row["lens_chi2"] is None else f"{row['lens_chi2']:.2f}"
        lines.append(
            f"| {row['run']} | {row['scene']} | {row['width']} | {row['images']} | {' | '.join(pairs)} | "
            f"{row['pose_chi2']:.2f} | {lens} | {row['spheres_moved_px']:.3f} ({row['of_which_noise_px']:.3f}) |"
        )
    return "\n".join(lines) + "\n"


def main(words: Sequence[str] | None = None) -> int:
    """Measure the kept runs, print the table and write it to the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="FOLDER", help="kept runs, with rig/ and data/")
    parser.add_argument("--most-images", type=int, default=40, metavar="N", help="of each run, evenly chosen (40)")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the result files (bench/results)")
    options = parser.parse_args(words)
    record: dict[str, Any] = {
        "date": options.date,
        "commit": commit(),
        "machine": machine(),
        "runs": [],
    }
    stem = options.results / f"stated_sigma-{options.date}"
    for folder in options.runs:
        record["runs"].append(measured(folder, options.most_images))
        print(record["runs"][-1], file=sys.stderr, flush=True)
        stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        stem.with_suffix(".md").write_text(as_markdown(record), encoding="utf-8")
    print(as_markdown(record))
    return 0


if __name__ == "__main__":
    sys.exit(main())
