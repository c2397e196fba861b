"""Precision, recall and accuracy of the sphere detector by condition: colour, background, light, occlusion, borders.

Spheres lie anywhere in the image, also across its border; those with at least 60 % of their outline visible are
expected.
"""

from __future__ import annotations

import argparse
import datetime
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from bench.machine import RESULTS
from bench.markers.outlines import LOOKS, SIDE_LAMP, TWO_LAMPS
from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, cone_of_sphere
from service.compute.markers.detect import DETECTORS
from service.compute.markers.records import DEFAULTS, SphereOutline, colour_of
from service.core.geometry import Array
from tests.support.scenes.sphere_conditions import COLOURS_BGR, Look, Picture, picture_of
from tests.support.scenes.sphere_images import RADIUS_M, camera

CONDITIONS = LOOKS | {
    "white glossy on white cloth": Look("white", "white cloth", TWO_LAMPS, gloss=0.6),
    "orange on blood, wires, stains": Look("orange", "blood", gloss=0.5, wires=6, stains=2),
    "green on skin, linear, quality 85": Look("green", "skin", srgb=False, quality=85),
    "orange on wood": Look("orange", "wood"),
    "grey on white cloth, side lamp": Look("grey", "white cloth", SIDE_LAMP),
}
EXPECTED = 0.6  # visible fraction of the outline
WRONG_PX = 0.5  # the covariance must reflect an error of this size
WRONG_SIGMA = 4.0


def places(cam: CameraModel, count: int, seed: int) -> Array:
    """Centres (count, 3) in the camera frame, anywhere in the image and rarely overlapping."""
    rng = np.random.default_rng(seed)
    kept: list[Array] = []
    pixels: list[Array] = []
    while len(kept) < count:
        pixel = rng.uniform([-10, -10], [cam.width + 10, cam.height + 10])
        depth = rng.uniform(0.45, 0.9)
        if all(np.linalg.norm(pixel - p) > 2.0 * RADIUS_M / 0.6 * cam.fx for p in pixels):
            pixels.append(pixel)
            kept.append(np.append(cam.normalise(pixel[None])[0], 1.0) * depth)
    return np.array(kept)


@dataclass
class Tally:
    """Results over the images of one condition."""

    errors_px: list[float] = field(default_factory=list[float])
    chi2: list[float] = field(default_factory=list[float])
    expected: int = 0
    recalled: int = 0
    false: int = 0
    found: int = 0
    overconfident: int = 0  # far off, although the covariance claims otherwise
    cpu_s: float = 0.0
    images: int = 0
    notes: list[str] = field(default_factory=list[str])

    def add(
        self, found: Sequence[SphereOutline], truth: Sequence[Cone], picture: Picture, cam: CameraModel, name: str
    ) -> None:
        """Compare the outlines of one image with ground truth."""
        self.images += 1
        self.found += len(found)
        taken: set[int] = set()
        visible = [picture.visible(cam, k, t) for k, t in enumerate(truth)]
        for o in found:
            gaps = [float(np.arccos(np.clip(o.cone.axis @ t.axis, -1, 1))) for t in truth]
            k = int(np.argmin(gaps)) if gaps else -1
            at = f"{name} at {o.centre_px[0]:.0f} {o.centre_px[1]:.0f}"
            if k < 0 or gaps[k] > 0.3 * truth[k].half_angle_rad:
                self.false += 1
                self.notes.append(f"{at} r {o.semi_axes_px[0]:.0f}: false, {_told(o)}")
                continue
            taken.add(k)
            e = np.array([*(o.cone.frame()[:, :2].T @ (truth[k].axis - o.cone.axis)), 0.0])
            e[2] = truth[k].half_angle_rad - o.cone.half_angle_rad
            chi2 = float(e @ np.linalg.solve(o.cone_covariance, e)) / 3
            error = float(np.sqrt((e[0] ** 2 + e[1] ** 2) / 2 + e[2] ** 2)) * cam.fx
            self.chi2.append(chi2)
            self.errors_px.append(error)
            if error > WRONG_PX and chi2 > WRONG_SIGMA**2:
                self.overconfident += 1
                self.notes.append(f"{at}: {error:.2f} px, chi2 {chi2:.0f}, in sight {visible[k]:.2f}, {_told(o)}")
        for k, part in enumerate(visible):
            if part >= EXPECTED:
                self.expected += 1
                self.recalled += k in taken
                if k not in taken:
                    u, v = cam.project(truth[k].axis[None])[0]
                    self.notes.append(f"{name} at {u:.0f} {v:.0f}: missed, in sight {part:.2f}")

    def row(self, name: str) -> str:
        """Format one line of the table."""
        precision = f"{1 - self.false / self.found:.3f}" if self.found else "–"
        recall = f"{self.recalled / self.expected:.3f}" if self.expected else "–"
        rms = median = chi2 = "–"
        if self.errors_px:
            rms = f"{np.sqrt(np.mean(np.square(self.errors_px))):.3f}"
            median = f"{np.median(self.errors_px):.3f}"
            chi2 = f"{np.median(self.chi2):.2f} / {np.percentile(self.chi2, 95):.1f}"
        return (
            f"| {name} | {self.recalled}/{self.expected} | {recall} | {self.false} | {precision} | {rms} | "
            f"{median} | {chi2} | {self.overconfident} | {self.cpu_s / max(self.images, 1):.2f} |"
        )


def _told(o: SphereOutline) -> str:
    return (
        f"coverage {o.coverage:.2f}, score {o.score:.2f}, sigma {o.sigma_px:.2f} px, contrast {o.contrast:.3f}, "
        f"colour {tuple(round(c) for c in o.colour_bgr)}"
    )


def measure(name: str, look: Look, images: int, width: int, count: int, detector: str, *, given: bool) -> Tally:
    """Measure one condition; with `given`, the detector knows the colour."""
    tally = Tally()
    cam = camera(width)
    options = replace(DEFAULTS, srgb=look.srgb)
    if given:
        colour, tolerance = colour_of(_hex(look))
        options = replace(options, colour_bgr=colour, colour_tolerance=tolerance)
    for i in range(images):
        centres = np.zeros((0, 3)) if name.startswith("no spheres") else places(cam, count, seed=100 + i)
        picture = picture_of(cam, centres, look, seed=i)
        start = time.process_time()
        found = DETECTORS[detector](picture.image, cam, options)
        tally.cpu_s += time.process_time() - start
        tally.add(found, [cone_of_sphere(c, RADIUS_M) for c in centres], picture, cam, f"{name} {i}")
    return tally


def _hex(look: Look) -> str:
    """The albedo as #rrggbb, as read from a photograph of a sphere."""
    linear = np.array(COLOURS_BGR[look.colour])[::-1]
    coded = (
        np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055) if look.srgb else linear
    )
    return "#" + "".join(f"{round(255 * c):02x}" for c in coded)


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=10, help="images per condition")
    parser.add_argument("--width", type=int, default=1000)
    parser.add_argument("--spheres", type=int, default=7, help="spheres per image")
    parser.add_argument("--only", default="", help="part of a condition's name")
    parser.add_argument("--detector", default="classical", choices=sorted(DETECTORS))
    parser.add_argument("--given", action="store_true", help="tell the detector the colour")
    parser.add_argument("--notes", action="store_true", help="print every missed, false or wrong outline")
    parser.add_argument("--write", action="store_true", help="write to bench/results")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    lines = [
        "# Spheres under many conditions", "",
        f"{options.images} images a condition, {options.width} px wide, {options.spheres} spheres each at random "
        f"places (tests/support/scenes/sphere_conditions.py); expected: {EXPECTED:.0%} of the outline in sight. "
        "Errors in px: axis (each direction) and radius together. Overconfident: beyond "
        f"{WRONG_PX} px and {WRONG_SIGMA:.0f} sigma.", "",
        "| condition | found | recall | false | precision | rms px | median px | chi² median / 95 % | overconfident "
        "| CPU-s an image |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, look in CONDITIONS.items():
        if options.only not in name:
            continue
        tally = measure(
            name, look, options.images, options.width, options.spheres, options.detector, given=options.given
        )
        lines.append(tally.row(name))
        print(lines[-1], flush=True)
        if options.notes:
            print("\n".join(f"    {note}" for note in tally.notes), flush=True)
        if options.write:
            target = RESULTS / f"sphere_conditions-{datetime.datetime.now(datetime.UTC):%Y-%m-%d}.md"
            target.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
