"""Consistency of the registration's stated sigmas: on rendered scenes with ground truth, and on drawn outlines."""

from __future__ import annotations

import argparse
import datetime
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench.machine import RESULTS, commit, machine
from bench.registration.accuracy import Capture, read_capture
from bench.registration.identity import CAMERA
from service.compute.markers.cones import Cone, cone_of_sphere
from service.compute.markers.image_files import detect_all
from service.compute.markers.records import (
    OutlineEvidence,
    SphereOutline,
    outline_from_cone,
    outline_from_record,
    outline_record,
)
from service.compute.pipeline import register_images
from service.compute.registration.accuracy import evaluate, leave_one_out, true_error_m
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import EXPECTED_COMMON_ERRORS, CommonErrors, RegistrationSettings
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform
from simulators.scene.world import RADIUS_M, Scene
from tests.support.scenes.rendered_scene import CACHE, render_scene
from tests.support.stated_errors import normalised_rms, sigma_components_m

SOURCES = ("true", "disturbed", "smooth", "robot")
SFM_NOISE = (3e-5 / np.sqrt(3), np.radians(0.003) / np.sqrt(3))  # per coordinate: 0.03 mm and 0.003° in total
ARM_NOISE = (4e-4, 4e-4)


def chi2(result: RegistrationResult, T_world_scan: Transform) -> float:
    """Squared error of T_world_scan (six numbers) in the metric of the stated covariance, per degree of freedom."""
    w = Rotation.from_matrix(T_world_scan[:3, :3] @ result.T_world_scan[:3, :3].T).as_rotvec()
    both = np.concatenate([T_world_scan[:3, 3] - result.T_world_scan[:3, 3], w])
    return float(both @ np.linalg.solve(result.covariance[:6, :6], both)) / 6


def disturbed(poses: Array, noise: tuple[float, float], rng: np.random.Generator) -> Array:
    """Poses (N, 4, 4) with independent position and rotation errors; `noise` is sigma per coordinate (m, rad)."""
    out = poses.copy()
    for T in out:
        T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * noise[1]).as_matrix() @ T[:3, :3]
        T[:3, 3] += rng.normal(size=3) * noise[0]
    return out


def disturbed_smoothly(poses: Array, noise: tuple[float, float], rng: np.random.Generator) -> Array:
    """Poses (N, 4, 4) with errors linear in the camera position, like the bending of a weak reconstruction."""
    out = poses.copy()
    place = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    place /= np.sqrt(np.mean(np.sum(place**2, axis=1)))
    bend, twist = rng.normal(size=(3, 3)) * noise[0], rng.normal(size=(3, 3)) * noise[1]
    for T, x in zip(out, place, strict=True):
        T[:3, :3] = Rotation.from_rotvec(twist @ x).as_matrix() @ T[:3, :3]
        T[:3, 3] += bend @ x
    return out


# Rendered scenes


def outlines_of(capture: Capture, workers: int, cache: Path | None) -> list[tuple[SphereOutline, ...]]:
    """Detected outlines; cached in `cache` if given."""
    file = None if cache is None else cache / f"{capture.folder.name}.json"
    if file is not None and file.is_file():
        stored = json.loads(file.read_text(encoding="utf-8"))
        return [tuple(outline_from_record(o, capture.camera) for o in image) for image in stored]
    found = detect_all(capture.files, capture.camera, workers=workers)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps([[outline_record(o) for o in image] for image in found]), encoding="utf-8")
    return list(found)


def rendered(capture: Capture, outlines: list[tuple[SphereOutline, ...]]) -> dict[str, dict[str, float]]:
    """Registrations of a scene from true poses, from poses with the errors of SfM or bent, and from robot poses."""
    rng = np.random.default_rng([capture.seed, 0x516])
    sources: dict[str, tuple[Array, list[int]]] = {
        "true": (capture.T_world_camera, [0] * len(outlines)),
        "disturbed": (disturbed(capture.T_world_camera, SFM_NOISE, rng), [0] * len(outlines)),
        "smooth": (disturbed_smoothly(capture.T_world_camera, SFM_NOISE, rng), [0] * len(outlines)),
        "robot": (capture.T_base_camera, capture.stations),
    }
    # The robot's base is known no better than its poses, so the cameras are compared there.
    return {
        name: _registered(capture, outlines, poses, groups, base_known=name != "robot")
        for name, (poses, groups) in sources.items()
    }


def _registered(
    capture: Capture,
    outlines: list[tuple[SphereOutline, ...]],
    poses: Array,
    groups: list[int],
    *,
    base_known: bool,
) -> dict[str, float]:
    """Errors and stated errors of one registration; without a known base, the cameras are compared."""
    spheres, controls = capture.true_registration_m, capture.true_control_m
    centre = spheres.mean(axis=0)
    T_scan_camera = inverse(capture.T_world_scan) @ capture.T_world_camera
    solved = register_images(
        outlines,
        PosedImages(poses, capture.camera, groups=groups),
        ScanSpheres(spheres, capture.radius_m, control_m=controls),
    )
    r = solved.registration
    refined_images = PosedImages(r.T_scan_camera_refined, capture.camera)
    controlled = ScanSpheres(controls, capture.radius_m)
    control = evaluate(outlines, solved.control_assignments, refined_images, controlled, registration=r)
    spared = leave_one_out(r, refined=True)
    sigma = r.sigma_at_m(centre)
    error = (
        float(np.linalg.norm(apply(r.T_world_scan, centre) - apply(capture.T_world_scan, centre)))
        if base_known
        else true_error_m(r.T_scan_camera, T_scan_camera, centre)
    )
    return {
        "true_error_mm": 1e3 * error,
        "true_error_refined_mm": 1e3 * true_error_m(r.T_scan_camera_refined, T_scan_camera, centre),
        "sigma_mm": 1e3 * sigma,
        "normalised": error / sigma,
        **({"error_chi2": chi2(r, capture.T_world_scan)} if base_known else {}),
        "residual_chi2": r.chi2_reduced,
        "pose_sigma_mm": 1e3 * r.pose_sigma[0],
        "pose_sigma_deg": float(np.degrees(r.pose_sigma[1])),
        "control_radial_mm": control.mean_radial_error_mm,
        "control_px": control.mean_reprojection_error_px,
        "control_normalised": normalised_rms(control) or 0.0,
        "left_out_radial_mm": spared.mean_radial_error_mm,
        "left_out_normalised": normalised_rms(spared) or 0.0,
        **{f"sigma_{k}_mm": 1e3 * v for k, v in sigma_components_m(r, centre).items()},
    }


# Drawn outlines


DISTANCE_M = 0.67
EXPECTED = EXPECTED_COMMON_ERRORS
NOTHING_COMMON = CommonErrors(shift_px=1e-5, growth_px=1e-5, light_px=1e-5)


@dataclass(frozen=True, slots=True)
class Case:
    """Sizes of the drawn errors; the solver knows all of them except those of the poses."""

    name: str
    outline_px: float = 0.1
    pose: tuple[float, float] = (0.0, 0.0)
    told: bool = False  # whether the solver knows the sizes of the pose errors
    spheres_m: float = 0.0
    common: CommonErrors = NOTHING_COMMON


CASES = (
    Case("outlines"),
    Case("outlines, poses as of structure from motion", pose=SFM_NOISE),
    Case("the same, their covariance stated", pose=SFM_NOISE, told=True),
    Case("outlines, poses as of an arm", pose=ARM_NOISE),
    Case("outlines, spheres of the scan 0.02 mm", spheres_m=2e-5),
    Case("outlines, common errors", common=EXPECTED),
    Case("all", pose=SFM_NOISE, spheres_m=2e-5, common=EXPECTED),
)


@dataclass(frozen=True, slots=True)
class _Common:
    """The drawn errors that all outlines of a capture share: of the light (3,), of the axis (2,), of the size."""

    light_m: Array
    shift_rad: Array
    growth_rad: float

    @classmethod
    def drawn(cls, case: Case, rng: np.random.Generator) -> _Common:
        light_m = rng.normal(size=3) * case.common.light_px * DISTANCE_M / CAMERA.fx
        shift_rad = rng.normal(size=2) * case.common.shift_px / CAMERA.fx
        return cls(light_m, shift_rad, float(rng.normal()) * case.common.growth_px / CAMERA.fx)


def _camera_pose(azimuth_rad: float, tilt_deg: float, centre_m: Array, rng: np.random.Generator) -> Transform:
    """T_scan_camera near a direction from the centre, which it looks at."""
    tilt = np.radians(tilt_deg + rng.uniform(-4, 4))
    out = np.array([np.sin(tilt) * np.cos(azimuth_rad), np.sin(tilt) * np.sin(azimuth_rad), np.cos(tilt)])
    eye = centre_m + rng.uniform(0.62, 0.72) * out
    return look_at(eye, centre_m + rng.uniform(-0.02, 0.02, 3), np.array([-out[0], -out[1], 0.3]))


def _outlines(
    case: Case, common: _Common, centres_camera_m: Array, rng: np.random.Generator
) -> tuple[tuple[SphereOutline, ...], list[int]]:
    """Outlines with drawn errors of the spheres (N, 3) that are well inside the image, and the indices of these."""
    pixels = CAMERA.project(centres_camera_m)
    inside = np.nonzero(np.all((pixels > 40) & (pixels < [CAMERA.width - 40, CAMERA.height - 40]), axis=1))[0]
    covariance = np.eye(3) * (case.outline_px / CAMERA.fx) ** 2
    evidence = OutlineEvidence(1.0, 0.2, 0.2, 300, 0.1, 0.3, (180.0, 180.0, 180.0), 0.9, covariance)
    found: list[SphereOutline] = []
    for m in inside:
        cone = cone_of_sphere(centres_camera_m[m], RADIUS_M)
        frame, d = cone.frame(), rng.normal(size=3) * case.outline_px / CAMERA.fx
        axis = cone.axis + frame[:, :2] @ d[:2]
        axis[:2] += common.shift_rad * cone.axis[2]
        size = cone.half_angle_rad + float(d[2]) + common.growth_rad * float(cone.axis[2])
        found.append(outline_from_cone(Cone(axis / np.linalg.norm(axis), size), CAMERA, 8, evidence))
    return tuple(found), [int(m) for m in inside]


def drawn(seed: int, case: Case, views: int = 18) -> tuple[RegistrationResult, Transform]:
    """Simulate a capture of `views` images with drawn errors; returns the result and the true T_world_scan."""
    rng = np.random.default_rng([seed, 0x5E])
    scan_m = _LABORATORIES[seed % len(_LABORATORIES)]
    T_world_scan = transform(Rotation.random(rng=rng), rng.uniform(-0.3, 0.3, 3))
    common = _Common.drawn(case, rng)
    poses: list[Transform] = []
    outlines: list[tuple[SphereOutline, ...]] = []
    markers: list[dict[int, int]] = []
    for k in range(views):
        azimuth = np.pi * (k // (views // 2)) + rng.uniform(-1.1, 1.1)
        T_scan_camera = _camera_pose(azimuth, (14, 32)[k % 2], scan_m.mean(axis=0), rng)
        found, inside = _outlines(case, common, apply(inverse(T_scan_camera), scan_m + common.light_m), rng)
        outlines.append(found)
        markers.append({j: int(m) for j, m in enumerate(inside)})
        poses.append(T_world_scan @ T_scan_camera)
    given = disturbed(np.array(poses), case.pose, rng)
    spheres = scan_m + rng.normal(size=scan_m.shape) * case.spheres_m
    covariance = np.tile(np.eye(3) * case.spheres_m**2, (len(scan_m), 1, 1)) if case.spheres_m else None
    stated = np.diag([case.pose[0] ** 2] * 3 + [case.pose[1] ** 2] * 3)
    result = register(
        outlines,
        [Assignment(m, inverse(T) @ T_world_scan) for m, T in zip(markers, given, strict=True)],
        PosedImages(given, CAMERA),
        ScanSpheres(spheres, RADIUS_M, covariance_m2=covariance),
        RegistrationSettings(
            pose_covariance=np.tile(stated, (views, 1, 1)) if case.told else "estimate", common_errors=case.common
        ),
    )
    return result, T_world_scan


_LABORATORIES = [Scene.generate(seed).registration_m for seed in range(101, 109)]


def monte_carlo(case: Case, seeds: int) -> dict[str, Any]:
    """Errors relative to their sigmas over many draws."""
    errors: list[float] = []
    normalised: list[float] = []
    squares: list[float] = []
    residual: list[float] = []
    for seed in range(seeds):
        result, truth = drawn(seed, case)
        centre = _LABORATORIES[seed % len(_LABORATORIES)].mean(axis=0)
        error = float(np.linalg.norm(apply(result.T_world_scan, centre) - apply(truth, centre)))
        errors.append(1e3 * error)
        normalised.append(error / result.sigma_at_m(centre))
        squares.append(chi2(result, truth))
        residual.append(result.chi2_reduced)
    return {
        "case": case.name,
        "seeds": seeds,
        "true_error_mm_median": float(np.median(errors)),
        "within_3_sigma": float(np.mean(np.array(normalised) < 3)),
        "normalised_rms": float(np.sqrt(np.mean(np.square(normalised)))),
        "error_chi2": float(np.mean(squares)),
        "residual_chi2": float(np.mean(residual)),
    }


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="*", default=list(range(1, 11)), metavar="SEED")
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--outlines", type=Path, help="folder in which to cache detected outlines")
    parser.add_argument("--large", type=int, nargs="*", default=[1, 2, 3], metavar="SEED", help="scenes 4752 px wide")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    options = parser.parse_args()
    cases: list[dict[str, Any]] = []
    for case in CASES if options.seeds else ():
        cases.append(monte_carlo(case, options.seeds))
        print(cases[-1], flush=True)
    scenes: dict[str, list[dict[str, Any]]] = {}
    captures = [(1920, 20, seed) for seed in options.scenes] + [(4752, 18, seed) for seed in options.large]
    for width, views, seed in captures:
        folder = render_scene(seed, width, views, cache=CACHE, workers=options.workers)
        capture = read_capture(seed, folder)
        row = rendered(capture, outlines_of(capture, options.workers, options.outlines))
        scenes.setdefault(str(width), []).append({"scene": seed, **row})
        print(width, seed, {source: round(row[source]["normalised"], 2) for source in SOURCES}, flush=True)
    record: dict[str, Any] = {
        "date": options.date, "commit": commit(), "machine": machine(), "drawn": cases, "rendered": scenes,
        "summary": {width: summary(rows) for width, rows in scenes.items()},
    }  # fmt: skip
    options.results.mkdir(parents=True, exist_ok=True)
    stem = options.results / f"registration_sigma-{options.date}"
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    stem.with_suffix(".md").write_text(as_markdown(record), encoding="utf-8")
    print(as_markdown(record))


def summary(scenes: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Median and worst of the errors, and their ratio to the sigmas, by source of poses."""
    out: dict[str, dict[str, float]] = {}
    for source in SOURCES if scenes else ():
        rows = [s[source] for s in scenes]
        n = np.array([r["normalised"] for r in rows])
        out[source] = {
            **{f"{k}_median": float(np.median([r[k] for r in rows])) for k in rows[0]},
            "true_error_mm_worst": max(r["true_error_mm"] for r in rows),
            **(
                {"error_chi2_mean": float(np.mean([r["error_chi2"] for r in rows]))}
                if "error_chi2" in rows[0]
                else {}
            ),
            "within_3_sigma": float(np.mean(n < 3)),
            "normalised_chi2": float(np.mean(n**2)),
        }
    return out


def as_markdown(record: dict[str, Any]) -> str:
    """Format the record as Markdown."""
    lines = [
        f"# Stated sigmas of the registration, {record['date']}",
        "",
        f"Commit {record['commit']}. chi²: mean square of the true error at the spheres' centre over its stated "
        "sigma (3D); of all six numbers in the metric of their covariance, a degree of freedom; of the residuals.",
        "",
        "## Drawn outlines, 18 images",
        "",
        "| errors drawn | seeds | true error, median (mm) | within 3 sigma | chi² | chi² of six | of residuals |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {c['case']} | {c['seeds']} | {c['true_error_mm_median']:.4f} | {100 * c['within_3_sigma']:.1f} % | "
        f"{c['normalised_rms'] ** 2:.2f} | {c['error_chi2']:.2f} | {c['residual_chi2']:.2f} |"
        for c in record["drawn"]
    ]
    for width, rows in record["summary"].items():
        lines += [
            "",
            f"## Rendered scenes, {width} px wide, {len(record['rendered'][width])} scenes",
            "",
            "True sphere centres. Robot: the cameras as refined in brackets; its sigma is that of poses as given.",
            "",
            "| poses | true error, median / worst (mm) | sigma (mm) | within 3 sigma | chi² | of six | of residuals "
            "| control spheres, normalised |",
            "|---|---:|---:|---:|---:|---:|---:|---:|",
        ]
        lines += [
            f"| {source} | {row['true_error_mm_median']:.4f} / {row['true_error_mm_worst']:.4f}"
            + (f" ({row['true_error_refined_mm_median']:.4f})" if source == "robot" else "")
            + f" | {row['sigma_mm_median']:.4f} | {100 * row['within_3_sigma']:.0f} % | {row['normalised_chi2']:.2f}"
            + " | "
            + (f"{row['error_chi2_mean']:.2f}" if "error_chi2_mean" in row else "")
            + f" | {row['residual_chi2_median']:.2f} | {row['control_normalised_median']:.2f} |"
            for source, row in rows.items()
        ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
