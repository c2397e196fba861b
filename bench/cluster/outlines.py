"""The scaling of the outlines of a job over local processes and the workers of a Dask cluster, and what bounds it.

The images are drawn at a small size. Only ratios count on a machine that others use too.
"""

from __future__ import annotations

import argparse
import json
import pickle
import statistics
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from bench.machine import RESULTS, machine
from service.compute.camera_model import CameraModel
from service.compute.markers.image_files import detect_all, detect_file
from service.compute.markers.records import DEFAULTS
from service.core.units import megabytes
from service.machine.executors import computing_at, mapping
from service.machine.remote_task import remote_task
from service.machine.schedulers import Scheduler
from tests.support.processes.cluster import dask_cluster
from tests.support.processes.cluster_tasks import square
from tests.support.scenes.sphere_images import CONTROL_M, REGISTRATION_M, render, scene

_EMPTY_TASKS = 300
_LARGE_WIDTH = 9504  # px, 60 megapixels
_LARGE_MB = 40.0  # of a JPEG of that size
_JOB_IMAGES = 108
_LINK_MB_S = 110.0  # 1 Gb/s
_WORKERS = (1, 2, 4, 8, 16, 32, 64, 100)


def draw(folder: Path, count: int, width: int) -> tuple[list[Path], CameraModel]:
    """Write images of a scene; returns them and their camera."""
    made = scene(count, width, seed=21)
    spheres = np.vstack([REGISTRATION_M, CONTROL_M])
    files = [folder / f"view_{i:03d}.jpg" for i in range(count)]
    for i, file in enumerate(files):
        picture = render(made.camera, made.centres_camera(i, spheres), i, oversample=1)
        cv2.imwrite(str(file), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return files, made.camera


def seconds_of_outlines(files: Sequence[Path], camera: CameraModel, workers: int) -> float:
    """Return the wall time of a search of all images."""
    begin = time.perf_counter()
    detect_all(files, camera, workers=workers)
    return time.perf_counter() - begin


def seconds_of_empty_task() -> float:
    """Return the wall time of one of many tasks that compute nothing."""
    begin = time.perf_counter()
    with mapping(2, _EMPTY_TASKS) as map_over:
        list(map_over(square, range(_EMPTY_TASKS)))
    return (time.perf_counter() - begin) / _EMPTY_TASKS


def seconds_of_large_image(folder: Path, file: Path, camera: CameraModel) -> float:
    """Return the CPU time of one image of 60 megapixels, searched whole: an enlarged one of the small ones."""
    larger = camera.scaled(_LARGE_WIDTH, round(camera.height * _LARGE_WIDTH / camera.width))
    picture = cv2.imread(str(file))
    assert picture is not None
    large = folder / "large.jpg"
    cv2.imwrite(str(large), cv2.resize(picture, (larger.width, larger.height)), [cv2.IMWRITE_JPEG_QUALITY, 95])
    cv2.setNumThreads(1)
    begin = time.process_time()
    detect_file(large, larger, DEFAULTS)
    return time.process_time() - begin


def on_paper(task_s: float, overhead_s: float) -> list[dict[str, float]]:
    """Return the time of a job's outlines by the number of workers, with images on local disks and over one link."""
    link_s = _JOB_IMAGES * _LARGE_MB / _LINK_MB_S
    rows: list[dict[str, float]] = []
    for workers in _WORKERS:
        rounds = -(-_JOB_IMAGES // workers)
        here_s = max(rounds * task_s, _JOB_IMAGES * overhead_s)
        there_s = max(here_s, link_s)
        rows.append({"workers": workers, "files_local_s": round(here_s, 1), "one_link_s": round(there_s, 1)})
    return rows


def measure(folder: Path, count: int, width: int, repeats: int) -> dict[str, object]:
    """Measure everything; returns the result."""
    files, camera = draw(folder, count, width)
    cv2.setNumThreads(1)
    took: dict[str, list[float]] = {}
    with ExitStack() as clusters:
        places: dict[str, tuple[Scheduler | None, int]] = {
            "1 local process": (None, 1),
            "2 local processes": (None, 2),
        }
        for workers in (1, 2):
            own = folder / f"cluster{workers}"
            own.mkdir()
            cluster = clusters.enter_context(dask_cluster(own, workers=workers))
            places[f"Dask, {number_of(workers)}"] = Scheduler(cluster.address, patience_s=90.0), 2
        empty_s = 0.0
        for turn in range(repeats):  # in turns, so that what else the machine does is shared out
            for name, (scheduler, processes) in places.items():
                with computing_at(scheduler):
                    detect_all(files[:2], camera, workers=processes)  # modules are imported, the connection is made
                    took.setdefault(name, []).append(seconds_of_outlines(files, camera, processes))
                    if scheduler is not None and turn == repeats - 1:
                        empty_s = seconds_of_empty_task()
    took_s = {name: statistics.median(values) for name, values in took.items()}
    found = detect_file(files[0], camera, DEFAULTS)
    task = remote_task(partial(detect_file, files[0], camera, DEFAULTS))
    large_s = seconds_of_large_image(folder, files[0], camera)
    return {
        "images": count,
        "width_px": width,
        "repeats": repeats,
        "all_took_s": {name: [round(value, 2) for value in values] for name, values in took.items()},
        "took_s": {name: round(value, 2) for name, value in took_s.items()},
        "task_bytes": len(pickle.dumps(task)),
        "result_bytes": len(pickle.dumps(found)),
        "image_mb": round(megabytes(statistics.mean(file.stat().st_size for file in files)), 3),
        "empty_task_s": round(empty_s, 4),
        "task_60_megapixels_s": round(large_s, 2),
        "on_paper": on_paper(large_s, empty_s),
        "machine": machine(),
    }


def number_of(workers: int) -> str:
    """Return the number of workers as text."""
    return "1 worker" if workers == 1 else f"{workers} workers"


def page(result: dict[str, object]) -> str:
    """Return the result as a page."""
    took = result["took_s"]
    rows = result["on_paper"]
    turns = result["all_took_s"]
    assert isinstance(took, dict)
    assert isinstance(turns, dict)
    assert isinstance(rows, list)
    alone = took["1 local process"]
    empty_ms = 1000 * float(str(result["empty_task_s"]))
    lines = [
        "# Outlines of a job, over processes and a Dask cluster",
        "",
        f"{result['images']} drawn images of {result['width_px']} px, each searched whole, on a machine of two",
        "hyperthreads of one core that others use too: only ratios count, and these roughly. Medians of",
        f"{result['repeats']} turns. The start of local processes is counted, that of a cluster is not; one thread",
        "of OpenCV each.",
        "",
        "| computed by | s | shortest and longest turn, s | times as fast as 1 local process |",
        "|---|---:|---:|---:|",
        *(
            f"| {name} | {value:.2f} | {min(turns[name]):.2f} to {max(turns[name]):.2f} | {alone / value:.2f} |"
            for name, value in took.items()
        ),
        "",
        "The one core bounds it here: a second process gains at most what a second hyperthread gives, and nothing",
        "while others use it. What a cluster adds to each task is in the next paragraph.",
        "",
        f"A task has {result['task_bytes']} bytes and its answer {result['result_bytes']}. One that computes nothing",
        f"takes {empty_ms:.1f} ms of the job's machine and the scheduler. An image of 60 megapixels, enlarged from a",
        f"drawn one and searched whole, takes {result['task_60_megapixels_s']} CPU seconds; a photograph, which",
        "compresses less well, takes longer to decode.",
        "",
        f"## On paper: {_JOB_IMAGES} images of 60 megapixels",
        "",
        "One worker a core, cores as this one. With files on the worker's own disk the last round bounds it; if all",
        f"images ({_LARGE_MB:.0f} MB each) come over one link of 1 Gb/s, that link does.",
        "",
        "| workers | files local, s | over one link, s |",
        "|---:|---:|---:|",
        *(f"| {row['workers']} | {row['files_local_s']} | {row['one_link_s']} |" for row in rows),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=24)
    parser.add_argument("--width", type=int, default=1200)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measure(Path(folder), args.images, args.width, args.repeats)
    name = f"cluster_outlines-{datetime.now(UTC):%Y-%m-%d}"
    (args.out / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (args.out / f"{name}.md").write_text(page(result), encoding="utf-8")
    print(page(result))


if __name__ == "__main__":
    main()
