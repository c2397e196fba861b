"""Peak memory of the jobs that compute on images, at 60 megapixels, and of the merging of a scan's parts.

Run: python -m bench.whole_runs.image_job_memory [--jobs develop …] [--parts 3]

Each job is computed in a process of its own, with the allocator set as a worker sets it. Its memory is looked at ten
times a second: the resident memory of the process and of those that it starts, as the worker counts it when it admits
jobs (service/computations/memory_grants.py). Inputs are made once, and kept: photographs with edges in every
direction as a simulated Sony writes them, and scans of the simulated scene with a million faces each. Figures go to
bench/results/image_job_memory-DATE, beside what each kind of job states.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil

from bench.machine import REPOSITORY, RESULTS, commit, machine
from bench.whole_runs.job_memory import RADIUS_M, SCENE, Folder
from service.computations.further_cameras import DEVELOP
from service.computations.image_poses import FEATURES, MATCH
from service.computations.job import JobContext, RecordedContext, handler_of
from service.computations.kind import JobKind
from service.computations.scans import MERGE_SCANS
from service.compute.photography import PARAMETERS
from service.core.units import megabytes
from service.machine.resources import keep_freed_memory
from simulators.rendering.sensor import bordered, camera_picture, read_out
from simulators.scan_station.station import scan_scene
from simulators.scene.world import Scene
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw

CACHE = REPOSITORY / "build" / "bench" / "image_job_memory"
WIDTH, HEIGHT = 9504, 6336
KINDS: dict[str, JobKind[Any, Any]] = {kind.name: kind for kind in (DEVELOP, FEATURES, MATCH, MERGE_SCANS)}
_CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 11000.0, "fy": 11000.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
_SETTINGS = ExposureSettings(22.0, 1 / 15, (1, 15), 100)


def make_inputs(folder: Path, parts: int) -> None:
    """Write the photographs and the parts of the scan that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "a.jpg").is_file():
        rng = np.random.default_rng(3)
        picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        for _ in range(60_000):
            middle = tuple(int(value) for value in rng.uniform(0, 1, 2) * (WIDTH, HEIGHT))
            colour = tuple(int(value) for value in rng.integers(30, 225, 3))
            cv2.ellipse(picture, middle, (28, 12), float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
        mosaic = read_out(bordered(picture), _SETTINGS.iso, 1)
        shot = Shot(_SETTINGS, 1, datetime(2026, 11, 27, tzinfo=UTC), PLATE)
        (folder / "a.raw").write_bytes(encode_raw(mosaic, shot))
        seen = camera_picture(mosaic)
        (folder / "b.jpg").write_bytes(encode_jpeg(np.roll(seen, 40, axis=1), shot))
        (folder / "a.jpg").write_bytes(encode_jpeg(seen, shot))
    for part in range(1, parts + 1):
        path = folder / f"part{part}.npz"
        if not path.is_file():
            scene = Scene.generate(SCENE)
            scan = scan_scene(scene, spray=True, control_spheres=False, spacing_m=5e-4, nth=part)
            np.savez(path, vertices_m=scan.vertices_m, faces=scan.faces.astype(np.int32))


def arguments(name: str, parts: int) -> dict[str, Any]:
    """The arguments of a job."""
    front = {"camera": _CAMERA, "effort": {}}
    every: dict[str, Callable[[], dict[str, Any]]] = {
        "develop": lambda: {"viewpoint": "a", "raw": "a.raw", "jpeg": "a.jpg", "parameters": asdict(PARAMETERS)},
        "features": lambda: {**front, "images": [{"viewpoint": name, "sha256": f"{name}.jpg"} for name in "ab"]},
        "match": lambda: {**front, "features": {n: f"{n}.features.npz" for n in "ab"}, "pairs": [["a", "b"]]},
        "merge_scans": lambda: {
            "meshes": [f"part{part}.npz" for part in range(1, parts + 1)],
            "radius_m": RADIUS_M,
            "expected": 10,
        },
    }
    return every[name]()


def compute(folder: Path, name: str, parts: int) -> None:
    """Compute a job in this process, and print what it measured."""
    keep_freed_memory()
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        given = arguments(name, parts)
        context: RecordedContext = JobContext(given, Folder(folder), Path(scratch), lambda *_: None)
        answer = handler_of(KINDS[name])(context)
    print(json.dumps({key: round(value, 5) for key, value in answer.measures.items()}))


def measured(command: list[str]) -> tuple[float, float, str, str]:
    """Peak memory in MB of a command and what it starts, its duration, and what it said."""
    began_s, peak_mb = time.monotonic(), 0.0
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            with suppress(psutil.Error):
                tree = (watched, *watched.children(recursive=True))
                peak_mb = max(peak_mb, sum(megabytes(one.memory_info().rss) for one in tree))
            time.sleep(0.1)
        out, err = process.communicate()
    return peak_mb, time.monotonic() - began_s, out, err


def main() -> int:
    """Compute each job, print and write the figures; returns 1 if one failed or took more than its kind states."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--parts", type=int, default=3)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--alone", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        compute(options.cache, options.alone, options.parts)
        return 0
    make_inputs(options.cache, options.parts)
    rows: list[dict[str, Any]] = []
    for name in options.jobs:
        own = ["--alone", name, "--cache", str(options.cache), "--parts", str(options.parts)]
        peak_mb, took_s, out, err = measured([sys.executable, "-m", "bench.whole_runs.image_job_memory", *own])
        kind = KINDS[name]
        stated_mb = kind.demand(kind.arguments.model_validate(arguments(name, options.parts))).memory_mb
        row = {"job": name, "peak_mb": round(peak_mb), "stated_mb": stated_mb, "seconds": round(took_s, 1)}
        found = {"measures": json.loads(out)} if out else {"failed": err[-500:]}
        rows.append(row | found)
        print(json.dumps(rows[-1]), flush=True)
    _write(rows, options.parts)
    return int(any("failed" in row or row["peak_mb"] > row["stated_mb"] for row in rows))


def _write(rows: list[dict[str, Any]], parts: int) -> None:
    day = datetime.now(UTC).date().isoformat()
    stem = RESULTS / f"image_job_memory-{day}"
    record = {"machine": machine(), "commit": commit(), "pixels": [WIDTH, HEIGHT], "parts": parts, "jobs": rows}
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    lines = [
        f"# Memory of the jobs that compute on images, {day}",
        "",
        f"`python -m bench.whole_runs.image_job_memory`: photographs of {WIDTH} × {HEIGHT} px, {parts} parts of",
        "a scan of a million faces each. Peak: resident memory of the process and of those that it starts. Stated:",
        "what the kind of job asks a worker for. Durations were measured beside other work.",
        "",
        "| job | peak (MB) | stated (MB) | duration (s) |",
        "|---|---:|---:|---:|",
        *(f"| {row['job']} | {row['peak_mb']} | {row['stated_mb']:.0f} | {row['seconds']} |" for row in rows),
        "",
        f"Commit {record['commit']}.",
    ]
    stem.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
