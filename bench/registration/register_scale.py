"""Registration of 16 to 1000 images: wall and CPU time relative to decoding, and memory of each process."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile

os.environ.setdefault("OMP_NUM_THREADS", "1")  # must be set before numpy loads its libraries
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import time
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from bench.machine import RESULTS, machine
from service.compute.images.photographs import read_image
from service.compute.markers.image_files import detect_all, locate_outlines
from service.compute.pipeline import register_images
from service.compute.poses.pose_files import read_camera_json, read_poses, read_spheres_json
from service.compute.scene import PosedImages, ScanSpheres
from tests.support.scenes.rendered_scene import rendered

FILES = (("scene01_9504_12", (16, 32, 64, 108)), ("scene01_1920_20", (250, 1000)))
SOLVE_FROM = "scene01_1920_20"
SOLVED = (16, 32, 64, 108, 250, 500, 1000)
POSE_NOISE_M = 2e-5  # noise added to repeated poses, so that no two are equal


def decode(path: Path) -> int:
    """Decode an image as the pipeline does."""
    cv2.setNumThreads(1)
    return read_image(path).shape[1]


def decode_all(files: list[Path], workers: int) -> None:
    """Decode the images with as many processes as the registration uses."""
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        list(pool.map(decode, files))


def locate_and_register(folder: Path, count: int, workers: int) -> dict[str, object]:
    """Run the whole chain from files to registration; the folder's images are reused under other names."""
    camera = read_camera_json(folder / "camera.json")
    known = read_spheres_json(folder / "spheres.json")
    originals = sorted((folder / "images").glob("*.jpg"))
    poses = read_poses(folder / "poses.csv", [file.name for file in originals])
    with tempfile.TemporaryDirectory() as scratch:
        files: list[Path] = []
        for i in range(count):
            original = originals[i % len(originals)]
            files.append(Path(scratch) / f"{i:04d}_{original.name}")
            files[-1].symlink_to(original.resolve())
        T_world_camera = np.array([poses[originals[i % len(originals)].name] for i in range(count)])
        begin = time.perf_counter()
        located = locate_outlines(
            files,
            PosedImages(T_world_camera, camera),
            ScanSpheres(known.centres_m, known.radius_m, control_m=known.control_m),
            workers=workers,
        )
        middle = time.perf_counter()
        solved = register_images(
            located.outlines,
            PosedImages(T_world_camera, camera),
            ScanSpheres(known.centres_m, known.radius_m, control_m=known.control_m),
            assignments=located.assignments,
        )
        end = time.perf_counter()
    return {
        "distinct": len(originals),
        "width": camera.width,
        "locate_s": middle - begin,
        "solve_s": end - middle,
        "predicted": located.count("predicted"),
        "outlines": sum(map(len, located.outlines)),
        "rms_px": solved.registration.rms_px,
    }


def solve_only(folder: Path, count: int) -> dict[str, object]:
    """Run identification and the joint solution on `count` images: repeated outlines with perturbed poses."""
    camera = read_camera_json(folder / "camera.json")
    known = read_spheres_json(folder / "spheres.json")
    files = sorted((folder / "images").glob("*.jpg"))
    poses = read_poses(folder / "poses.csv", [file.name for file in files])
    T_world_camera = np.array([poses[file.name] for file in files])
    located = locate_outlines(
        files, PosedImages(T_world_camera, camera), ScanSpheres(known.centres_m, known.radius_m), workers=2
    )
    assert located.assignments is not None
    pick = [i % len(files) for i in range(count)]
    rng = np.random.default_rng(0)
    many = T_world_camera[pick] + 0.0
    many[:, :3, 3] += rng.normal(0, POSE_NOISE_M, (count, 3))
    outlines = [located.outlines[i] for i in pick]
    assignments = [located.assignments[i] for i in pick]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    timed: dict[str, float] = {}
    for label, given in (("propagated", assignments), ("identified", None)):
        begin = time.process_time()
        register_images(
            outlines, PosedImages(many, camera), ScanSpheres(known.centres_m, known.radius_m), assignments=given
        )
        timed[f"{label}_cpu_s"] = time.process_time() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"images": count, "peak_mib": peak, "before_mib": before, **timed}


def one(arguments: list[str]) -> dict[str, object]:
    """Run one measurement in a separate process, so that its children are only those being measured."""
    answer = subprocess.run(
        [sys.executable, "-m", "bench.registration.register_scale", *arguments],
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(answer.stdout.splitlines()[-1])


def measured(kind: str, folder: Path, count: int, workers: int) -> dict[str, object]:
    """Run one measurement in this process and its children."""
    begin = time.perf_counter()
    answer: dict[str, object] = {}
    if kind == "decode":
        originals = sorted((folder / "images").glob("*.jpg"))
        decode_all([originals[i % len(originals)] for i in range(count)], workers)
    elif kind == "register":
        answer = locate_and_register(folder, count, workers)
    elif kind == "whole":
        originals = sorted((folder / "images").glob("*.jpg"))
        files = [originals[i % len(originals)] for i in range(count)]
        detect_all(files, read_camera_json(folder / "camera.json"), workers=workers)
    else:
        return solve_only(folder, count)
    wall = time.perf_counter() - begin
    children, here = resource.getrusage(resource.RUSAGE_CHILDREN), resource.getrusage(resource.RUSAGE_SELF)
    return {
        "images": count,
        **answer,
        "wall_s": wall,
        "cpu_s": children.ru_utime + children.ru_stime + here.ru_utime + here.ru_stime,
        "worker_peak_mib": children.ru_maxrss / 1024,
        "parent_peak_mib": here.ru_maxrss / 1024,
    }


def compare(folder: Path, count: int, workers: int) -> dict[str, object]:
    """Run the registration between two decodings of the same images, so that other load affects both."""
    first = one(["decode", str(folder), str(count), str(workers)])
    row = one(["register", str(folder), str(count), str(workers)])
    second = one(["decode", str(folder), str(count), str(workers)])
    decode_wall = 0.5 * (float(str(first["wall_s"])) + float(str(second["wall_s"])))
    decode_cpu = 0.5 * (float(str(first["cpu_s"])) + float(str(second["cpu_s"])))
    return {
        **row,
        "workers": workers,
        "decode_wall_s": decode_wall,
        "decode_cpu_s": decode_cpu,
        "wall_ratio": float(str(row["wall_s"])) / decode_wall,
        "cpu_ratio": float(str(row["cpu_s"])) / decode_cpu,
    }


def markdown(columns: dict[str, str], rows: list[dict[str, object]]) -> str:
    """Format a table."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(form.format(row[name]) for name, form in columns.items()) + " |" for row in rows]
    return "\n".join(lines)


def main() -> None:
    """Measure and write the results; with a kind, run one measurement for the parent process."""
    if len(sys.argv) == 5 and sys.argv[1] in {"decode", "register", "whole", "solve"}:
        print(json.dumps(measured(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))))
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", nargs="*", metavar="FOLDER:N,N", help="folders and image counts")
    parser.add_argument("--solved", type=int, nargs="*", default=list(SOLVED))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    if options.files is None:
        wanted = [(rendered(name), counts) for name, counts in FILES]
    else:
        wanted = [
            (Path(folder), tuple(map(int, counts.split(","))))
            for folder, counts in (word.rsplit(":", 1) for word in options.files)
        ]
    rows: list[dict[str, object]] = []
    solved = [one(["solve", str(rendered(SOLVE_FROM)), str(n), "1"]) for n in options.solved]
    for folder, counts in wanted:
        for n in counts:
            rows.append(compare(folder, n, options.workers))
            write(rows, solved, options.out)  # after each measurement, because they take long


def write(rows: list[dict[str, object]], solved: list[dict[str, object]], out: Path) -> None:
    """Write the results as JSON and Markdown."""
    rows = sorted(rows, key=lambda row: (-int(str(row["width"])), int(str(row["images"]))))
    here = machine()
    name = f"register_scale-{datetime.now(UTC):%Y-%m-%d}"
    out.mkdir(parents=True, exist_ok=True)
    document = {"machine": here, "files": rows, "solved": solved}
    (out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    files = {
        "width": "{:d}", "images": "{:d}", "distinct": "{:d}", "workers": "{:d}", "decode_wall_s": "{:.1f}",
        "wall_s": "{:.1f}", "wall_ratio": "{:.2f}", "cpu_ratio": "{:.2f}", "solve_s": "{:.1f}",
        "worker_peak_mib": "{:.0f}", "parent_peak_mib": "{:.0f}", "predicted": "{:d}", "rms_px": "{:.2f}",
    }  # fmt: skip
    joint = {
        "images": "{:d}", "propagated_cpu_s": "{:.2f}", "identified_cpu_s": "{:.2f}", "before_mib": "{:.0f}",
        "peak_mib": "{:.0f}",
    }  # fmt: skip
    text = f"""# Registration by number of images

{here["processor"]}, {here["cores"]} cores, shared with other work: the ratios count, not the times. Simulated scene.

## From files

Search, identity, joint solution, evaluation on control spheres, start of the processes; against decoding the same
files with as many processes. `distinct` images are used again under other names, each decoded anew. Limit at 60 MP:
1.3 times the decoding, 2048 MiB for each process.

{markdown(files, rows)}

## Identity and joint solution alone

Outlines of 20 images repeated, poses 0.02 mm apart: CPU seconds with identity known from the prediction, and with
identity sought in all images; memory of the process before and at its peak.

{markdown(joint, solved)}
"""
    (out / f"{name}.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
