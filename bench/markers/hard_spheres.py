"""Sphere detection on difficult images (large under twelve lamps, glossy, orange in pale images) and usual ones.

Each run adds its rows to the result under its label, so that two revisions can be compared.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.machine import RESULTS, machine
from bench.markers.outlines import LOOKS, TWO_LAMPS
from bench.markers.sphere_conditions import measure, places
from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.compute.markers.detect import detect_spheres, options_for
from service.compute.markers.records import DetectionOptions
from service.core.geometry import Array
from tests.support.scenes.sphere_conditions import Look, render_look
from tests.support.scenes.sphere_images import RADIUS_M, camera

RIGHT = 0.05  # in radii: an outline within this distance and size difference counts as correct
LIGHTS = 12
SHARES = (0.21,)  # radius as a fraction of the image width
USUAL = (
    "white on skin",
    "dark green on green cloth",
    "orange on blood, glossy",
    "green, wires and blood stains",
    "no spheres, blood",
)


@dataclass
class Tally:
    """Detection counts of one group of spheres."""

    expected: int = 0
    right: int = 0
    wrong: int = 0  # at a sphere, but of another size, such as a ring on it
    false: int = 0  # where there is no sphere
    radius_off: list[float] = field(default_factory=list[float])  # of the correct outlines, in px
    cpu_s: float = 0.0
    images: int = 0

    def add(self, cam: CameraModel, centres: Array, look: Look, options: DetectionOptions, seed: int) -> None:
        """Detect the spheres in one image and count the results."""
        image = render_look(cam, centres, look, seed)
        start = time.process_time()
        found = detect_spheres(image, cam, options)
        self.cpu_s += time.process_time() - start
        self.images += 1
        truth = [cone_of_sphere(c, RADIUS_M) for c in centres]
        self.expected += len(truth)
        seen: set[int] = set()
        for outline in found:
            gaps = [float(np.linalg.norm(outline.cone.axis - t.axis)) / t.half_angle_rad for t in truth]
            k = int(np.argmin(gaps))
            off = outline.cone.half_angle_rad - truth[k].half_angle_rad
            if gaps[k] > 1:
                self.false += 1
            elif max(gaps[k], abs(off) / truth[k].half_angle_rad) < RIGHT:
                seen.add(k)
                self.radius_off.append(abs(off) * cam.fx)
            else:
                self.wrong += 1
        self.right += len(seen)


def lights() -> Iterator[tuple[tuple[float, float, float], float]]:
    """Twelve lamps around the camera, from beside it to far to the side, one at a time."""
    for k in range(LIGHTS):
        tilt, around = np.radians(20 + 15 * (k % 4)), 2 * np.pi * k / LIGHTS
        across = float(np.sin(tilt))
        yield ((across * float(np.cos(around)), across * float(np.sin(around)), -float(np.cos(tilt))), 0.8)


def large(share: float) -> Tally:
    """A grey ball in front of black velvet under each lamp in turn, with its size given."""
    tally, cam = Tally(), camera(280)
    centre = np.array([[0.03 * RADIUS_M, -0.1 * RADIUS_M, RADIUS_M * cam.fx / (share * cam.width)]])
    for k, lamp in enumerate(lights()):
        look = Look("grey", "black velvet", (lamp,), ambient=0.01, gloss=0.1, posts=False)
        tally.add(cam, centre, look, options_for(None, 0.4), seed=k)
    return tally


def glossy() -> Tally:
    """A ball on a table that reflects the room: the horizon appears as a ring at three quarters of its radius."""
    tally, cam = Tally(), camera(280)
    centre = np.array([[0.005, 0.0, 0.12]])
    for colour in ("white", "orange", "grey"):
        for mirror in (0.2, 0.45):
            for up in ((0.0, 0.0, -1.0), (0.0, -0.3, -0.95)):
                look = Look(colour, "table", mirror=mirror, up=up, posts=False, gloss=0.3)
                tally.add(cam, centre, look, options_for(None, 0.4), seed=1)
    return tally


def pale(share: float) -> Tally:
    """Orange balls in low-contrast images with a wrong white balance, with their colour given by name."""
    tally, cam = Tally(), camera(600)
    for seed in range(1):
        centres = places(cam, 12, seed=40 + seed)
        inside = np.all(np.abs(cam.project(centres) - [cam.width / 2, cam.height / 2]) < [260, 160], axis=1)
        look = Look("orange", "table", TWO_LAMPS, pale=share, balance_bgr=(1.0, 0.95, 0.9), blur_px=1.0, noise=0.008)
        tally.add(cam, centres[inside], look, options_for("orange"), seed)
    return tally


def hard(label: str) -> list[dict[str, Any]]:
    """Rows of the difficult images."""
    rows: list[dict[str, Any]] = []
    made = [
        *((f"large: radius {share:.0%} of the width, {LIGHTS} lights", lambda s=share: large(s)) for share in SHARES),
        ("glossy balls that mirror the horizon", glossy),
        *((f"orange told, {share:.0%} of white light over it", lambda s=share: pale(s)) for share in (0.2, 0.4)),
    ]
    for name, make in made:
        tally = make()
        off = float(np.median(tally.radius_off)) if tally.radius_off else None
        rows.append(
            {"label": label, "pictures": name, "spheres": tally.expected, "right": tally.right, "ring": tally.wrong,
             "false": tally.false, "radius_off_px": off, "cpu_s": tally.cpu_s / tally.images}
        )  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def usual(label: str, images: int) -> list[dict[str, Any]]:
    """Rows of the usual images of bench/markers/sphere_conditions.py, but fewer and smaller."""
    rows: list[dict[str, Any]] = []
    for name in USUAL:
        tally = measure(name, LOOKS[name], images, 600, 6, "classical", given=False)
        rms = float(np.sqrt(np.mean(np.square(tally.errors_px)))) if tally.errors_px else None
        rows.append(
            {"label": label, "pictures": name, "spheres": tally.expected, "found": tally.recalled,
             "false": tally.false, "rms_px": rms, "cpu_s": tally.cpu_s / tally.images}
        )  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def _table(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> str:
    labels = list(dict.fromkeys(row["label"] for row in rows))
    lines = [f"| pictures | spheres | {' | '.join(f'{c}, {label}' for c in columns for label in labels)} |"]
    lines.append("|" + "---|" * (2 + len(columns) * len(labels)))
    for name in dict.fromkeys(row["pictures"] for row in rows):
        of = {row["label"]: row for row in rows if row["pictures"] == name}
        cells = [_cell(of.get(label, {}).get(c)) for c in columns for label in labels]
        lines.append(f"| {name} | {next(iter(of.values()))['spheres']} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)


def main() -> None:
    """Measure and add the rows to the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--label", required=True, help="label of the measured revision")
    parser.add_argument("--images", type=int, default=1, help="images per usual condition")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    file = options.out / f"hard_spheres-{datetime.now(UTC):%Y-%m-%d}.json"
    document: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"hard": [], "usual": []}
    document["machine"] = machine()
    for part, rows in (("hard", hard(options.label)), ("usual", usual(options.label, options.images))):
        document[part] = [row for row in document[part] if row["label"] != options.label] + rows
    file.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    text = f"""# Spheres that were missed or mistaken

`python -m bench.markers.hard_spheres --label NAME`, rendered by tests/support/scenes/sphere_conditions.py with exact
outlines, 280 and 600 px wide; {document["machine"]["processor"]}, {document["machine"]["cores"]} cores, shared with
other work. CPU seconds of one thread an image. Right: place and radius within {RIGHT:.0%} of the radius; ring: at a
sphere, but of another size; false: where none is. The largest radius is told (0.4 of the width)
where spheres are large or glossy.

{_table(document["hard"], ("right", "ring", "false", "radius_off_px", "cpu_s"))}

The usual pictures, six spheres each, whole or cut by the border (bench/markers/sphere_conditions.py has more):

{_table(document["usual"], ("found", "false", "rms_px", "cpu_s"))}
"""
    file.with_suffix(".md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
