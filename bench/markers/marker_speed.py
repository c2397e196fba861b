"""CPU time of the markers per image, without decoding, at three resolutions on one thread."""

from __future__ import annotations

import argparse
import csv
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # must be set before numpy loads its libraries
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.machine import RESULTS, machine
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image, read_reduced
from service.compute.markers.detect import detect_spheres
from service.compute.markers.image_files import ANCHOR_WIDTH_PX
from service.compute.markers.predicted import WIDE, PredictedSpheres, Tone, locate_predicted, tone_of
from service.compute.markers.records import SphereOutline
from service.compute.poses.pose_files import read_camera_json, read_poses, read_spheres_json
from service.core.geometry import inverse
from tests.support.scenes.rendered_scene import rendered

SCENES = ("scene01_1920_20", "scene01_4752_18", "scene01_9504_12")
LIMIT_S = 0.15  # for the markers of a 60 MP image
_T = TypeVar("_T")


def cpu(work: Callable[[], _T]) -> tuple[float, _T]:
    """Return the CPU seconds of this process for `work`, and its result."""
    begin = time.process_time()
    result = work()
    return time.process_time() - begin, result


def _whole_image(
    file: Path, camera: CameraModel
) -> tuple[dict[str, float], NDArray[np.uint8], tuple[SphereOutline, ...]]:
    """CPU seconds of reading and searching a whole image; the image, and the outlines in it at a reduced width."""
    decode_s, image = cpu(partial(read_image, file))
    imread_s, _ = cpu(partial(cv2.imread, str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION))
    reduced_s, (small, small_camera) = cpu(partial(read_reduced, file, camera, ANCHOR_WIDTH_PX))
    anchor_s, outlines = cpu(partial(detect_spheres, small, small_camera))
    row = {
        "decode_s": decode_s,
        "imread_s": imread_s,
        "anchor_decode_s": reduced_s,
        "anchor_search_s": anchor_s,
        "whole_search_s": cpu(partial(detect_spheres, image, camera))[0],
    }
    return row, image, outlines


def measure(folder: Path, most: int) -> dict[str, object]:
    """Return medians over the images of a folder made by bench/scenes.py.

    The search regions come from the true poses (as good as those of structure from motion), and from the erroneous
    robot poses with the margin that they need.
    """
    camera = read_camera_json(folder / "camera.json")
    truth = json.loads((folder / "truth.json").read_text())
    known = read_spheres_json(folder / "spheres.json")
    centres = np.vstack([known.centres_m, known.control_m])
    files = sorted((folder / "images").glob("*.jpg"))[:most]
    names = [file.name for file in files]
    T_scan_world = inverse(np.array(truth["T_world_scan"]))
    exact = read_poses(folder / "poses.csv", names)
    flange = read_poses(folder / "robot_poses.csv", names)
    with (folder / "stations.csv").open(newline="", encoding="utf-8") as file:
        station = {row["image"]: row["station"] for row in csv.DictReader(file)}
    T_flange_camera = np.array(truth["T_flange_camera"])
    rows: list[dict[str, float]] = []
    tone: Tone | None = None
    for file in files:
        row, image, outlines = _whole_image(file, camera)
        tone = tone or tone_of(outlines)
        T_world_base = np.array(truth["T_world_base"][station[file.name]])
        for label, T_world_camera, margin in (
            ("exact", exact[file.name], 0.05),
            ("robot", T_world_base @ flange[file.name] @ T_flange_camera, WIDE),
        ):
            expected = PredictedSpheres(inverse(T_scan_world @ T_world_camera), centres, known.radius_m, margin, tone)
            row[f"{label}_s"], found = cpu(partial(locate_predicted, image, camera, expected))
            row[f"{label}_found"] = len(found.outlines)
            row[f"{label}_expected"] = len(found.outlines) + len(found.missing)
        rows.append(row)
    middle = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
    return {
        "width": camera.width,
        "height": camera.height,
        "images": len(files),
        "median_bytes": float(np.median([file.stat().st_size for file in files])),
        **middle,
        "exact_ratio": middle["exact_s"] / middle["decode_s"],
        "robot_ratio": middle["robot_s"] / middle["decode_s"],
        "whole_ratio": middle["whole_search_s"] / middle["decode_s"],
    }


def table(results: list[dict[str, object]]) -> str:
    """Format the results as Markdown."""
    columns = {
        "width": "{:d}",
        "images": "{:d}",
        "decode_s": "{:.3f}",
        "exact_s": "{:.3f}",
        "robot_s": "{:.3f}",
        "whole_search_s": "{:.2f}",
        "exact_ratio": "{:.2f}",
        "robot_ratio": "{:.2f}",
        "exact_found": "{:.0f}",
        "exact_expected": "{:.0f}",
        "anchor_decode_s": "{:.3f}",
        "anchor_search_s": "{:.2f}",
    }
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(form.format(row[name]) for name, form in columns.items()) + " |" for row in results]
    return "\n".join(lines)


def main() -> None:
    """Measure the folders and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="*", help="rendered captures")
    parser.add_argument("--most", type=int, default=6, help="maximum number of images per folder")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    folders = options.folders or [rendered(name) for name in SCENES]
    results = [measure(folder, options.most) for folder in folders]
    name = f"marker_speed-{datetime.now(UTC):%Y-%m-%d}"
    options.out.mkdir(parents=True, exist_ok=True)
    here = machine()
    document = {"machine": here, "limit_s": LIMIT_S, "results": results}
    (options.out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    text = f"""# Markers beside decoding

{here["processor"]}, {here["cores"]} cores, shared with other work.
CPU seconds of one thread, medians over the images; simulated scene, JPEG quality 94 (4:2:0).
`exact`: the markers of an image (registration and control spheres) where poses as good as those of structure from
motion predict them; `robot`: where the poses of an arm that errs do, regions searched wider. The limit at 60 MP is
{LIMIT_S} s. `anchor`: the reduced decoding and the search of the few images that are searched whole first;
`whole_search`: what every image would cost without prediction.

{table(results)}
"""
    (options.out / f"{name}.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
