"""Outlines against ground truth by condition: bias, rms, common shift, covariance consistency, recall, precision.

Two renderers: the project's scenes (bench/scenes.py) and tests/support/scenes/sphere_conditions.py.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.machine import RESULTS
from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_of_sphere
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import DEFAULTS, DetectionOptions
from service.core.geometry import Array
from tests.support.scenes.sphere_conditions import Look, render_look
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, camera, scene

TWO_LAMPS = (((0.8, -0.2, -0.5), 0.45), ((-0.7, -0.4, -0.6), 0.4))
SIDE_LAMP = (((0.95, 0.1, -0.25), 0.8),)
FRONT_LAMP = (((0.05, -0.1, -1.0), 0.75),)
LOOKS = {
    "white on skin": Look(),
    "green on wood": Look("green", "wood"),
    "green, front lamp, wood": Look("green", "wood", FRONT_LAMP),
    "green, side lamp, blood": Look("green", "blood", SIDE_LAMP),
    "green glossy, two lamps, skin": Look("green", "skin", TWO_LAMPS, gloss=0.5),
    "green on green cloth": Look("green", "green cloth"),
    "dark green on green cloth": Look("dark green", "green cloth"),
    "white on white cloth": Look("white", "white cloth", SIDE_LAMP),
    "orange on blood, glossy": Look("orange", "blood", gloss=0.7, shininess=25),
    "grey on wood": Look("grey", "wood"),
    "blue on green cloth": Look("blue", "green cloth"),
    "green, blur 0.4, quality 97": Look("green", "wood", blur_px=0.4, quality=97),
    "green, blur 1.5, quality 80": Look("green", "wood", blur_px=1.5, quality=80),
    "green, defocus 3 px": Look("green", "skin", blur_px=3.0),
    "white, 4:4:4": Look("white", "blood", subsampled=False),
    "green, linear values": Look("green", "skin", srgb=False),
    "green, noise 1.5 %": Look("green", "wood", noise=0.015),
    "green, wires and blood stains": Look("green", "skin", wires=8, stains=2),
    "white, wires and blood stains": Look("white", "wood", wires=8, stains=2),
    "green behind tissue": Look("green", "skin", tissue=4),
    "no spheres, green cloth": Look("green", "green cloth"),
    "no spheres, blood": Look("green", "blood"),
}


@dataclass
class Tally:
    """Results over the images of one condition."""

    errors_px: list[Array] = field(default_factory=list[Array])
    shift_px: list[Array] = field(default_factory=list[Array])
    chi2: list[float] = field(default_factory=list[float])
    expected: int = 0
    recalled: int = 0
    false: int = 0
    cpu_s: float = 0.0
    images: int = 0

    def add(self, image: NDArray[np.uint8], cam: CameraModel, truth: list[Cone], options: DetectionOptions) -> None:
        """Detect and compare; every sphere fully inside the image is expected."""
        start = time.process_time()
        found = detect_spheres(image, cam, options)
        self.cpu_s += time.process_time() - start
        self.images += 1
        taken: set[int] = set()
        for o in found:
            gaps = [float(np.arccos(np.clip(o.cone.axis @ t.axis, -1, 1))) for t in truth]
            k = int(np.argmin(gaps)) if gaps else -1
            if k < 0 or gaps[k] > 0.15 * truth[k].half_angle_rad:
                self.false += 1
                continue
            taken.add(k)
            e = np.array([*(o.cone.frame()[:, :2].T @ (truth[k].axis - o.cone.axis)), 0.0])
            e[2] = truth[k].half_angle_rad - o.cone.half_angle_rad
            self.chi2.append(float(e @ np.linalg.solve(o.cone_covariance, e)) / 3)
            self.errors_px.append(-e * cam.fx)
            self.shift_px.append((cam.project(o.cone.axis[None]) - cam.project(truth[k].axis[None]))[0])
        for k, t in enumerate(truth):
            rim = cam.project(t.rays(np.linspace(0, 6.2, 32), np.full(32, t.half_angle_rad)))
            if np.all((rim > 2) & (rim < np.array([cam.width, cam.height]) - 3)):
                self.expected += 1
                self.recalled += k in taken

    def row(self, name: str) -> str:
        """Format one line of the table."""
        head = f"| {name} | {self.recalled}/{self.expected} | {self.false} |"
        tail = f" {self.cpu_s / max(self.images, 1):.2f} |"
        if not self.errors_px:
            return head + " | | | | | |" + tail
        e, shift, chi2 = np.array(self.errors_px), np.array(self.shift_px), np.array(self.chi2)
        rms = np.sqrt(e[:, 2] ** 2 + (e[:, 0] ** 2 + e[:, 1] ** 2) / 2)
        dx, dy = shift.mean(axis=0)
        return (
            head
            + f" {e[:, 2].mean():+.3f} | {np.sqrt(np.mean(rms**2)):.3f} | {np.median(rms):.3f} |"
            + f" {dx:+.3f} {dy:+.3f} | {chi2.mean():.2f} / {np.median(chi2):.2f} |"
            + tail
        )


def analytic(look: Look, name: str, images: int) -> Tally:
    """One condition of the second renderer."""
    tally = Tally()
    made = scene(images, 1280, seed=5)
    centres = np.vstack([REGISTRATION_M, CONTROL_M])
    if name.startswith("no spheres"):
        centres = centres[:0]
    options = replace(DEFAULTS, srgb=look.srgb)
    for i in range(images):
        c = made.centres_camera(i, centres) if len(centres) else centres
        picture = render_look(made.camera, c, look, seed=i)
        tally.add(picture, made.camera, [cone_of_sphere(x, RADIUS_M) for x in c], options)
    return tally


def captures(folder: Path, every: int) -> Iterator[tuple[Path, CameraModel, list[Cone]]]:
    """Images of a rendered scene, with the cones of the spheres that are visible to the camera."""
    record = json.loads((folder / "camera.json").read_text())
    names = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    cam = CameraModel.from_record({k: record[k] for k in names})
    T = np.array(json.loads((folder / "truth.json").read_text())["T_world_scan"])
    spheres = json.loads((folder / "spheres.json").read_text())
    centres = 1e-3 * np.vstack([spheres["registration_mm"], spheres["control_mm"]]) @ T[:3, :3].T + T[:3, 3]
    with (folder / "poses.csv").open(encoding="utf-8") as file:
        for row in list(csv.DictReader(file))[::every]:
            R = Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")]).as_matrix()
            local = (centres - [float(row[k]) for k in "xyz"]) @ R
            yield (
                folder / "images" / row["image"],
                cam,
                [cone_of_sphere(c, 1e-3 * spheres["radius_mm"]) for c in local],
            )


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--every", type=int, default=5, help="use every n-th image of a scene")
    parser.add_argument("--images", type=int, default=2, help="images per condition")
    parser.add_argument("--only", default="", help="part of a condition's name")
    parser.add_argument("--write", action="store_true", help="write to bench/results")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    lines = [
        "# Outlines against the truth", "", f"Camera of the conditions: 1280 px wide, f {camera(1280).fx:.0f} px. "
        "Errors in px: mean of the outline (bias), rms over outlines, median; shift: mean in x and y.", "",
        "| condition | found | false | bias | rms | median | shift x y | chi² mean / median | CPU-s an image |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for folder in options.scenes:
        tally = Tally()
        for path, cam, truth in captures(folder, options.every):
            image = cv2.imread(str(path))
            assert image is not None
            tally.add(np.asarray(image, dtype=np.uint8), cam, truth, DEFAULTS)
        lines.append(tally.row(folder.name))
        print(lines[-1], flush=True)
    for name, look in LOOKS.items():
        if options.only in name:
            lines.append(analytic(look, name, options.images).row(name))
            print(lines[-1], flush=True)
    if options.write:
        target = RESULTS / f"outlines-{datetime.datetime.now(datetime.UTC):%Y-%m-%d}.md"
        target.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
