"""What developed raw files gain over JPEGs: errors of outlines and of the registration, on one exposure of each view.

The sensor of the simulated camera is read out once for each view. The JPEG is what the camera makes of these values,
the developed picture what `service/compute/images/develop.py` makes of them. Outlines are found in the JPEG, and
measured in both; so both have the same spheres, and every ratio is of one run. Beside them is the JPEG of a sensor
without colour filters, which measures three colours in every pixel: the simulated camera's JPEG where no raw file is
asked for.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.machine import RESULTS, commit, machine
from service.compute.camera_model import CameraModel
from service.compute.images.develop import coded, develop
from service.compute.images.photographs import read_image
from service.compute.markers.cones import Cone, cone_of_sphere
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import SphereOutline
from service.compute.markers.refine import remeasure
from service.compute.photography import PARAMETERS, DevelopParameters
from service.compute.pipeline import register_images
from service.compute.registration.accuracy import true_error_m
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, apply, inverse
from service.core.units import mm
from simulators.rendering.render import Renderer
from simulators.rendering.sensor import camera_picture, read_out
from simulators.scene.world import Scene
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw
from tests.support.scenes.rendered_scene import SETTINGS, plan_shots

JPEG, RAW, NO_FILTERS = "JPEG", "developed raw file", "JPEG without colour filters"
_TARGET_M = np.array([0.0, 0.0, 0.05])  # middle of the specimen, frame of the world
_SAME = 0.15  # of the radius: largest distance of an outline from its sphere


@dataclass(frozen=True, slots=True)
class Conditions:
    """Holds what is measured."""

    seed: int
    width: int
    views: int
    iso: int
    demosaics: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Files:
    """The files of one view."""

    jpeg: Path
    raw: Path
    no_filters: Path


def expose(scene: Scene, renderer: Renderer, conditions: Conditions, folder: Path) -> list[tuple[Files, Array]]:
    """The files of each view, and T_world_camera (4, 4)."""
    out: list[tuple[Files, Array]] = []
    settings = ExposureSettings(22.0, 1 / 15, (1, 15), conditions.iso)
    # At a higher sensitivity the exposure is shorter, so that the picture is as bright.
    light = SETTINGS | {"iso": conditions.iso, "exposure_s": SETTINGS["exposure_s"] * 100 / conditions.iso}
    for number, planned in enumerate(plan_shots(scene, conditions.views)):
        T_world_camera = scene.true_camera(planned.q, planned.station)
        view = {
            "T_world_camera": T_world_camera.tolist(),
            "intrinsics": scene.lens.to_json(),
            "scene": {"seed": scene.seed, "spray": False, "control_spheres": True, "board": None},
            "light_lux": scene.light_lux,
        }
        shot = Shot(settings, number, datetime.now(UTC), PLATE)
        mosaic = read_out(renderer.light(view, light), conditions.iso, number)
        files = Files(*(folder / f"{number}{end}" for end in (".jpg", ".arw", "_no_filters.jpg")))
        files.jpeg.write_bytes(encode_jpeg(camera_picture(mosaic), shot))
        files.raw.write_bytes(encode_raw(mosaic, shot))
        files.no_filters.write_bytes(encode_jpeg(renderer.render(view, light, number), shot))
        out.append((files, T_world_camera))
    return out


@dataclass
class Measured:
    """The outlines that one kind of picture gives, by view, and their errors."""

    outlines: list[tuple[SphereOutline, ...]]
    centre_px: list[float]
    radius_px: list[float]
    seconds: float = 0.0

    def add(self, found: Sequence[SphereOutline], truth: Sequence[Cone], camera: CameraModel) -> None:
        """Compare the outlines of one view with the true cones."""
        self.outlines.append(tuple(found))
        for outline in found:
            apart = [float(np.linalg.norm(outline.cone.axis - cone.axis)) for cone in truth]
            true = truth[int(np.argmin(apart))]
            if min(apart) < _SAME * true.half_angle_rad:
                both = camera.project(np.array([outline.cone.axis, true.axis]))
                self.centre_px.append(float(np.linalg.norm(both[0] - both[1])))
                self.radius_px.append(camera.fx * (outline.cone.half_angle_rad - true.half_angle_rad))


def measure(conditions: Conditions) -> dict[str, dict[str, float]]:
    """The figures of each kind of picture."""
    scene, renderer = Scene.generate(conditions.seed), Renderer(conditions.width)
    lens = scene.camera_intrinsics(conditions.width)
    camera = CameraModel.from_record(lens.to_json())
    centres = np.vstack([scene.registration_m, scene.control_m])
    names = [JPEG, NO_FILTERS, *(f"{RAW}, {name}" for name in conditions.demosaics)]
    kinds = {name: Measured([], [], []) for name in names}
    poses: list[Array] = []
    with tempfile.TemporaryDirectory() as folder:
        for files, T_world_camera in expose(scene, renderer, conditions, Path(folder)):
            poses.append(T_world_camera)
            truth = [cone_of_sphere(c, scene.radius_m) for c in apply(inverse(T_world_camera), centres)]
            jpeg = read_image(files.jpeg)
            found = {JPEG: detect_spheres(jpeg, camera)}
            found[NO_FILTERS] = detect_spheres(read_image(files.no_filters), camera)
            for name in conditions.demosaics:
                began = time.process_time()
                picture = _developed(files.raw, jpeg, replace(PARAMETERS, demosaic=name))
                again = remeasure(picture, camera, found[JPEG])
                kinds[f"{RAW}, {name}"].seconds += time.process_time() - began
                found[f"{RAW}, {name}"] = tuple(outline for outline in again if outline is not None)
            for name in names:
                kinds[name].add(found[name], truth, camera)
    spheres = ScanSpheres(scene.registration_m, scene.radius_m, control_m=scene.control_m)
    return {name: _figures(kind, camera, np.array(poses), spheres) for name, kind in kinds.items()}


def _developed(raw: Path, jpeg: NDArray[np.uint8], parameters: DevelopParameters) -> NDArray[np.uint16]:
    return coded(develop(raw, jpeg, parameters).image_bgr)


def _figures(kind: Measured, camera: CameraModel, T_world_camera: Array, spheres: ScanSpheres) -> dict[str, float]:
    registration = register_images(kind.outlines, PosedImages(T_world_camera, camera), spheres).registration
    error_m = true_error_m(registration.T_scan_camera, T_world_camera, _TARGET_M)
    radius = np.array(kind.radius_px)
    return {
        "outlines": len(kind.centre_px),
        "centre_median_px": float(np.median(kind.centre_px)),
        "centre_rms_px": float(np.sqrt(np.mean(np.square(kind.centre_px)))),
        "radius_bias_px": float(np.median(radius)),
        "radius_spread_px": float(1.4826 * np.median(np.abs(radius - np.median(radius)))),
        "registration_error_mm": mm(error_m),
        "seconds_a_view": kind.seconds / len(kind.outlines),
    }


def page(conditions: Sequence[Conditions], results: Sequence[Mapping[str, Mapping[str, float]]]) -> str:
    """The results as Markdown."""
    on = machine()
    lines = [
        "# Outlines in developed raw files and in JPEGs",
        "",
        f"{on['processor']}, {on['cores']} cores; revision {commit()}; {datetime.now(UTC):%Y-%m-%d}.",
        "Simulated rig, true poses and intrinsics; both files of one exposure of a sensor with an RGGB mosaic and 14",
        "bits. Errors of the outlines' centres against the projected centres of the spheres, px; bias and spread of",
        "their radii, px; error of the registration at the middle of the specimen, mm. The last column is the median",
        "error of the centre over that of the JPEG.",
        "",
    ]
    for condition, kinds in zip(conditions, results, strict=True):
        lines += [
            f"## Scene {condition.seed}, {condition.width} px wide, {condition.views} views, ISO {condition.iso}",
            "",
            "| picture | outlines | centre, median | rms | radius, bias | spread | registration, mm | ratio |",
            "|---|---:|---:|---:|---:|---:|---:|---:|",
        ]
        base = kinds[JPEG]
        for name, figures in kinds.items():
            lines.append(
                f"| {name} | {figures['outlines']:.0f} | {figures['centre_median_px']:.4f} | "
                f"{figures['centre_rms_px']:.4f} | {figures['radius_bias_px']:+.4f} | "
                f"{figures['radius_spread_px']:.4f} | {figures['registration_error_mm']:.4f} | "
                f"{figures['centre_median_px'] / base['centre_median_px']:.2f} |"
            )
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Measure every scene and sensitivity, print, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--iso", type=int, nargs="+", default=[100, 800])
    parser.add_argument("--demosaics", nargs="+", default=["PPG", "VNG", "AHD"])
    parser.add_argument("--write", action="store_true", help="write to bench/results")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    conditions = [
        Conditions(seed, options.width, options.views, iso, tuple(options.demosaics))
        for seed in options.seeds
        for iso in options.iso
    ]
    results = [measure(condition) for condition in conditions]
    text = page(conditions, results)
    print(text)
    if options.write:
        name = f"raw_gain-{options.width}-{datetime.now(UTC):%Y-%m-%d}"
        (RESULTS / f"{name}.md").write_text(text, encoding="utf-8")
        record: dict[str, Any] = {"machine": machine(), "commit": commit(), "scenes": results}
        (RESULTS / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
