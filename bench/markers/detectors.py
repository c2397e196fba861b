"""The detectors side by side under hard conditions: white on white cloth, blood, occlusion, hard light.

`grounded` and `vote` take part where ORTHOCAPTURE_GROUNDED names a folder with their weights; elsewhere the table
says that they did not. Seconds are of the process on all its threads, or of the wall clock with a GPU.
"""

from __future__ import annotations

import argparse
import datetime
import os
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from bench.machine import RESULTS, commit, machine
from bench.markers.outlines import LOOKS
from bench.markers.sphere_conditions import CONDITIONS, Tally, places
from service.compute.markers.cones import cone_of_sphere
from service.compute.markers.detect import DETECTORS, Detector
from service.compute.markers.grounded import VARIABLE, GroundedDetector, load_networks, weights_in
from service.compute.markers.records import DEFAULTS
from tests.support.scenes.sphere_conditions import Look, picture_of
from tests.support.scenes.sphere_images import RADIUS_M, camera

HARD = {
    name: CONDITIONS[name]
    for name in (
        "white glossy on white cloth", "orange on blood, glossy", "orange on blood, wires, stains",
        "white, wires and blood stains", "green behind tissue",
    )
} | {
    "white glossy, sun-like light": replace(LOOKS["white on skin"], lamps=(((0.6, -0.6, -0.5), 1.6),), gloss=0.6),
}  # fmt: skip


def detectors(spheres: int) -> dict[str, Detector]:
    """Every detector that can run here."""
    found = dict(DETECTORS)
    if VARIABLE in os.environ:
        networks = load_networks(weights_in())
        found["grounded"] = GroundedDetector(networks, spheres).detect
        found["vote"] = GroundedDetector(networks, spheres, vote=True).detect
    return found


def measured(name: str, look: Look, detector: Detector, images: int, width: int, spheres: int) -> Tally:
    """One detector under one condition."""
    tally = Tally()
    cam = camera(width)
    for i in range(images):
        centres = places(cam, spheres, seed=200 + i)
        picture = picture_of(cam, centres, look, seed=i)
        start = time.process_time()
        found = detector(picture.image, cam, replace(DEFAULTS, srgb=look.srgb))
        tally.cpu_s += time.process_time() - start
        tally.add(found, [cone_of_sphere(c, RADIUS_M) for c in centres], picture, cam, f"{name} {i}")
    return tally


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=5, help="images per condition")
    parser.add_argument("--width", type=int, default=1000)
    parser.add_argument("--spheres", type=int, default=7, help="spheres per image")
    parser.add_argument("--only", default="", help="part of a condition's name")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    able = detectors(options.spheres)
    today = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d")
    weights = "" if "grounded" in able else f" `grounded` and `vote` did not run: {VARIABLE} names no weights here."
    lines = [
        "# Detectors under hard conditions", "",
        f"`python -m bench.markers.detectors`, {today}, commit {commit()}, {machine()['processor']}. "
        f"{options.images} images a condition, {options.width} px wide, {options.spheres} spheres each.{weights}", "",
        "| condition | detector | found | recall | false | rms px | CPU-s an image |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]  # fmt: skip
    for name, look in HARD.items():
        if options.only not in name:
            continue
        for word, detector in able.items():
            tally = measured(name, look, detector, options.images, options.width, options.spheres)
            rms_px = float(np.sqrt(np.mean(np.square(tally.errors_px)))) if tally.errors_px else float("nan")
            lines.append(
                f"| {name} | {word} | {tally.recalled}/{tally.expected} | {tally.recalled / tally.expected:.3f} | "
                f"{tally.false} | {rms_px:.2f} | {tally.cpu_s / tally.images:.2f} |"
            )
            print(lines[-1], flush=True)
    (options.out / f"detectors-{today}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
