"""The sizes of the tasks inside a job, a few of each kind at full size: CPU seconds, bytes in and out, memory.

Then a registration's front end at small size and an export at full size over 1, 2 and 4 workers, and what both follow
for 1,000 views and for 108 depth maps of 60 megapixels on up to 100 workers: a calculation, no measurement.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import pickle
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import distributed
import numpy as np
import psutil

from bench.machine import RESULTS, commit, machine
from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.images.render import RayMesh
from service.compute.images.views import Splits, coded_depth
from service.compute.sfm.front_end import PAIRS_A_TASK, FrontEnd
from service.compute.sfm.options import SfmOptions, pairs_of
from service.compute.surfaces.surface import Surface
from service.core.geometry import Transform
from service.core.units import megabytes
from service.dataset.exporter import exporter, png, write_data_set
from service.dataset.pixels import Photographs, undistorted_data_set
from service.dataset.records import DataSet, Mesh, PosedView
from service.machine.executors import computing_at, mapping
from service.machine.schedulers import Scheduler
from tests.support.processes.cluster import Cluster, dask_cluster
from tests.support.processes.cluster_tasks import square
from tests.support.scenes.slab_data_set import slab_mesh
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs

_FULL_WIDTH, _FULL_HEIGHT = 9504, 6336
_PHOTOGRAPH_MB = 40.0  # a JPEG of 60 megapixels from the camera; the drawn one compresses better
_LINK_MB_S = 110.0  # 1 Gb/s
_WORKERS = (1, 2, 4, 8, 16, 32, 64, 100)
_VIEWS, _NEIGHBOURS, _DEPTH_MAPS = 1000, 8, 108


@dataclass(frozen=True)
class TaskSize:
    """The CPU time, bytes read, bytes returned or written, and memory of one task."""

    kind: str
    cpu_s: float
    in_mb: float
    out_mb: float
    memory_mb: float
    how: str


def measure(work: Callable[[], tuple[float, float]]) -> tuple[float, float, float, float]:
    """Call `work` in a process of its own; returns its CPU time, both its sizes, MB, and the process's peak, MB."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_measure, work).result()


def _measure(work: Callable[[], tuple[float, float]]) -> tuple[float, float, float, float]:
    cv2.setNumThreads(1)
    begin_s, _ = _used()
    came, went = work()
    cpu_s, peak_mb = _used()
    return cpu_s - begin_s, came, went, peak_mb


def _used() -> tuple[float, float]:
    """Return the CPU seconds, and the sum of the largest memories (MB), of this process and its children."""
    own = psutil.Process()
    cpu_s = peak_mb = 0.0
    for process in [own, *own.children(recursive=True)]:
        times = process.cpu_times()
        cpu_s += times.user + times.system
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
        peak_mb += megabytes(1024 * int(status.partition("VmHWM:")[2].split()[0]))
    return cpu_s, peak_mb


def draw(folder: Path, count: int, width: int) -> tuple[list[Path], CameraModel, list[Transform]]:
    """Write images of a textured scene; returns them, their camera and their poses."""
    camera = camera_of_width(width)
    poses = ring_of_poses(max(count, 24))[:count]
    files = [folder / f"view_{width}_{k:03d}.jpg" for k in range(count)]
    for k, (file, pose) in enumerate(zip(files, poses, strict=True)):
        cv2.imwrite(str(file), render(slabs(), camera, pose, k), [cv2.IMWRITE_JPEG_QUALITY, 95])
    return files, camera, poses


def full_size(file: Path, folder: Path, camera: CameraModel) -> tuple[Path, CameraModel]:
    """Write an image enlarged to 60 megapixels, with fine noise as photographs have it; returns its camera too."""
    picture = read_image(file)
    large = np.asarray(
        cv2.resize(picture, (_FULL_WIDTH, _FULL_HEIGHT), interpolation=cv2.INTER_CUBIC), dtype=np.uint8
    )
    noise = np.random.default_rng(0).integers(-6, 7, (512, 512, 3)).astype(np.int16)
    tiles = np.tile(noise, (_FULL_HEIGHT // 512 + 1, _FULL_WIDTH // 512 + 1, 1))[:_FULL_HEIGHT, :_FULL_WIDTH]
    noisy = np.clip(large + tiles, 0, 255).astype(np.uint8)
    out = folder / "full.jpg"
    cv2.imwrite(str(out), noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return out, camera.scaled(_FULL_WIDTH, _FULL_HEIGHT)


def extraction(file: Path, camera: CameraModel) -> tuple[float, float]:
    """Extract the features of an image; returns MB read and returned."""
    found = FrontEnd(camera, SfmOptions()).extract_features(file)  # its child lives on, and is measured too
    return megabytes(file.stat().st_size), megabytes(len(pickle.dumps(found)))


def matching(files: list[Path], camera: CameraModel) -> tuple[float, float]:
    """Match the pairs of one task of features in files; returns MB read and returned."""
    names = {str(k): file for k, file in enumerate(files)}
    pairs = [("0", str(k)) for k in range(1, PAIRS_A_TASK + 1)]
    found = FrontEnd(camera, SfmOptions()).match_pairs(names, pairs)
    return megabytes(sum(file.stat().st_size for file in files)), megabytes(len(pickle.dumps(found)))


def mesh_of(faces: int) -> Surface:
    """Return the scene's surface with about so many faces."""
    surface = slab_mesh()
    vertices, triangles = surface.vertices_m, surface.faces
    while len(triangles) < faces:  # each face becomes four
        a, b, c = (vertices[triangles[:, k]] for k in range(3))
        start = len(vertices)
        n = len(triangles)
        vertices = np.concatenate([vertices, (a + b) / 2, (b + c) / 2, (c + a) / 2])
        ab, bc, ca = (start + k * n + np.arange(n) for k in range(3))
        i, j, k = triangles.T
        triangles = np.concatenate(
            [np.column_stack(t) for t in ((i, ab, ca), (ab, j, bc), (ca, bc, k), (ab, bc, ca))]
        )
    return Surface(vertices, triangles)


def depth(camera: CameraModel, pose: Transform, faces: int) -> tuple[float, float]:
    """Compute a depth map of 60 megapixels and code it as PNG; returns MB read and written."""
    surface = mesh_of(faces)
    data = data_set([], camera, [pose], surface)
    sent_mb = megabytes(len(pickle.dumps(data)))
    return sent_mb, megabytes(len(png(coded_depth(data.pixels.depth_m(data.views[0])))))


def undistortion(file: Path, camera: CameraModel, pose: Transform) -> tuple[float, float]:
    """Undistort a photograph of 60 megapixels and code it again; returns MB read and written."""
    data = undistorted_data_set(data_set([file], camera, [pose], mesh_of(1)))
    return megabytes(file.stat().st_size), megabytes(len(data.pixels.picture(data.views[0])))


def data_set(files: list[Path], camera: CameraModel, poses: list[Transform], surface: Surface) -> DataSet:
    """Return a data set of images before a surface."""
    names = [f"view_{k:03d}" for k in range(len(poses))]
    views = tuple(
        PosedView(name, ".jpg", camera, pose, 1e-8 * np.eye(6)) for name, pose in zip(names, poses, strict=True)
    )
    pixels = Photographs(dict(zip(names, files, strict=False)), RayMesh(surface.vertices_m, surface.faces), ())
    mesh = Mesh(surface.vertices_m, surface.faces)
    splits = Splits(train=tuple(names), test=(), dense=tuple(names), sparse=tuple(names[:1]))
    return DataSet("bench", True, {}, views, pixels, mesh, splits)


def task_sizes(folder: Path, faces: int) -> list[TaskSize]:
    """Measure one task of each kind at full size, each in a process of its own."""
    small, camera, poses = draw(folder, 1, 2376)
    file, full = full_size(small[0], folder, camera)
    pinhole = replace(full, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    with FrontEnd(full, SfmOptions()) as front:
        stored = [folder / f"{k}.npz" for k in range(PAIRS_A_TASK + 1)]
        data = front.extract_features(file).to_bytes()
    for path in stored:
        path.write_bytes(data)
    works: dict[str, tuple[Callable[[], tuple[float, float]], str]] = {
        "features of an image": (partial(extraction, file, full), "60 megapixels, read and reduced to 3200 px"),
        f"{PAIRS_A_TASK} pairs": (partial(matching, stored, full), "3000 features an image, all of which match"),
        "depth map": (partial(depth, pinhole, poses[0], faces), f"60 megapixels, {faces / 1e6:.1f} M faces, PNG"),
        "undistorted image": (partial(undistortion, file, full, poses[0]), "60 megapixels, JPEG of quality 97"),
    }
    sizes: list[TaskSize] = []
    for kind, (work, how) in works.items():
        cpu_s, came, went, peak = measure(work)
        sizes.append(TaskSize(kind, round(cpu_s, 2), round(came, 2), round(went, 3), round(peak), how))
    return sizes


def front_end(files: list[Path], camera: CameraModel, poses: list[Transform], folder: Path, processes: int) -> None:
    """Extract and match images, as a registration does."""
    options = SfmOptions(max_features=1500, neighbours=4)
    images = {file.name: file for file in files}
    with FrontEnd(camera, options, processes=processes) as front:
        stored = {name: folder / f"{name}.npz" for name in images}
        for name, found in front.extract_all(images).items():
            stored[name].write_bytes(found.to_bytes())
        front.match_pairs(stored, pairs_of(images, dict(zip(images, poses, strict=True)), options))


def full_size_data_set(folder: Path, views: int, faces: int) -> DataSet:
    """Return a data set of so many photographs of 60 megapixels before a mesh of about so many faces."""
    files, camera, poses = draw(folder, views, 2376)
    full = camera
    for k, file in enumerate(files):
        made, full = full_size(file, folder, camera)
        files[k] = made.rename(folder / f"full_{k:03d}.jpg")
    return data_set(files, full, poses, mesh_of(faces))


def grow(cluster: Cluster, workers: int) -> None:
    """Add workers to a cluster until it has so many, and wait for them."""
    while len(cluster.workers) < workers:
        cluster.add_worker()
    with distributed.Client(cluster.address, set_as_default=False) as client:
        client.wait_for_workers(workers, timeout=300)


def connect(processes: int) -> None:
    """Have a few tasks computed that take nothing: the connection is made then."""
    with mapping(processes, 8) as map_over:
        list(map_over(square, range(8)))


def scaling(folder: Path, views: int, width: int, repeats: int, data: DataSet) -> dict[str, dict[str, float]]:
    """Return the wall time of a front end and of the export of `data`, by who computes: medians of turns."""
    files, camera, poses = draw(folder, views, width)
    took: dict[str, dict[str, float]] = {}

    def compute(name: str, scheduler: Scheduler | None, processes: int) -> None:
        turns: list[tuple[float, float]] = []
        for turn in range(repeats):
            out = folder / f"{name}, {turn}"
            with computing_at(scheduler), tempfile.TemporaryDirectory() as scratch:
                connect(processes)
                begin = time.perf_counter()
                front_end(files, camera, poses, Path(scratch), processes)
                middle = time.perf_counter()
                write_data_set(data, exporter("nerfstudio"), out, processes=processes if processes > 1 else None)
                turns.append((middle - begin, time.perf_counter() - middle))
        front_s, export_s = (round(statistics.median(each), 2) for each in zip(*turns, strict=True))
        took[name] = {"front end": front_s, "export": export_s}

    compute("this process", None, 1)
    compute("2 local processes", None, 2)
    own = folder / "cluster"
    own.mkdir()
    with dask_cluster(own, workers=0) as cluster:
        for workers in (1, 2, 4):
            grow(cluster, workers)
            name = "Dask, 1 worker" if workers == 1 else f"Dask, {workers} workers"
            compute(name, Scheduler(cluster.address, patience_s=90.0), 2)
    return took


def on_paper(sizes: list[TaskSize]) -> dict[str, list[dict[str, float]]]:
    """Return seconds by the number of workers: by processors alone, and by one link of 1 Gb/s for all files."""
    features, pairs, depths, _ = sizes
    count = _VIEWS * _NEIGHBOURS * 0.6 / PAIRS_A_TASK  # choices are mutual in part
    out: dict[str, list[dict[str, float]]] = {"registration": [], "depth": []}
    for workers in _WORKERS:
        cpu_s = -(-_VIEWS // workers) * features.cpu_s + count / workers * pairs.cpu_s
        sent_mb = _VIEWS * (_PHOTOGRAPH_MB + features.out_mb) + count * (pairs.in_mb + pairs.out_mb)
        out["registration"].append(_row(workers, cpu_s, sent_mb))
        cpu_s = -(-_DEPTH_MAPS // workers) * depths.cpu_s
        out["depth"].append(
            _row(workers, cpu_s, min(workers, _DEPTH_MAPS) * depths.in_mb + _DEPTH_MAPS * depths.out_mb)
        )
    return out


def _row(workers: int, cpu_s: float, sent_mb: float) -> dict[str, float]:
    link_s = sent_mb / _LINK_MB_S
    return {
        "workers": workers,
        "local_s": round(cpu_s, 1),
        "link_s": round(link_s, 1),
        "s": round(max(cpu_s, link_s), 1),
    }


def _times(result: dict[str, Any], row: dict[str, float], what: str) -> str:
    """Say how many times as fast as one worker of a cluster somebody was."""
    return f"{result['scaling']['Dask, 1 worker'][what] / row[what]:.2f}"


def page(result: dict[str, Any]) -> str:
    """Return the result as a page."""
    about = result["machine"]
    lines = [
        "# Tasks inside a job: their sizes, and how far they scale",
        "",
        f"{about['processor']}, {about['cores']} hyperthreads that others use too (load {result['load']}); revision",
        f"{result['commit']}. CPU seconds hardly depend on the load. Wall times do: only rough ratios count.",
        "",
        "## Measured: one task of each kind, at full size",
        "",
        "| task | CPU s | MB in | MB out | memory of the process, MB | of |",
        "|---|---:|---:|---:|---:|---|",
        *(
            f"| {s['kind']} | {s['cpu_s']} | {s['in_mb']} | {s['out_mb']} | {s['memory_mb']} | {s['how']} |"
            for s in result["sizes"]
        ),
        "",
        "The tree for rays of the whole mesh is built in the depth map's time, and COLMAP's child process started in",
        "that of the first two: a worker does both once an export or a job.",
        "",
        f"## Measured: features and pairs of {result['views']} views of {result['width_px']} px, and an export of",
        f"{result['exported']} views of 60 megapixels (nerfstudio: undistorted images and depth maps)",
        "",
        "| computed by | front end, s | against 1 worker | export, s | against 1 worker |",
        "|---|---:|---:|---:|---:|",
        *(
            f"| {name} | {row['front end']} | {_times(result, row, 'front end')} "
            f"| {row['export']} | {_times(result, row, 'export')} |"
            for name, row in result["scaling"].items()
        ),
        "",
        "One core with two hyperthreads bounds it here: more than two workers share what two have.",
        "The start of local processes is counted, a cluster's is not.",
        "",
        f"## Calculated, not measured: {_VIEWS} views, and {_DEPTH_MAPS} depth maps of 60 megapixels",
        "",
        "One worker a core, cores as this one. `processors`: the tasks of the fullest worker. `link`: all files over",
        f"one link of 1 Gb/s, photographs of {_PHOTOGRAPH_MB:.0f} MB, the mesh once a worker. The larger one bounds.",
        "Features and pairs only; the mapping after them is one process.",
        "",
    ]
    titles = {"registration": f"features and pairs of {_VIEWS} views", "depth": f"{_DEPTH_MAPS} depth maps"}
    for what, rows in result["on_paper"].items():
        lines += [
            f"| workers: {titles[what]} | processors, s | link, s | both, s |",
            "|---:|---:|---:|---:|",
            *(f"| {row['workers']} | {row['local_s']} | {row['link_s']} | {row['s']} |" for row in rows),
            "",
        ]
    return "\n".join(lines)


def main() -> None:
    """Measure, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--exported", type=int, default=6, help="photographs of 60 megapixels in the export")
    parser.add_argument("--faces", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    load = f"{os.getloadavg()[1]:.1f}"
    with tempfile.TemporaryDirectory() as folder:
        sizes = task_sizes(Path(folder), args.faces)
        print(json.dumps([asdict(size) for size in sizes], indent=1), flush=True)
        data = full_size_data_set(Path(folder), args.exported, args.faces)
        took = scaling(Path(folder), args.views, args.width, args.repeats, data)
    result = {
        "sizes": [asdict(size) for size in sizes],
        "views": args.views,
        "width_px": args.width,
        "exported": args.exported,
        "repeats": args.repeats,
        "scaling": took,
        "on_paper": on_paper(sizes),
        "load": load,
        "commit": commit(),
        "machine": machine(),
    }
    name = f"cluster_tasks-{datetime.now(UTC):%Y-%m-%d}"
    (args.out / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (args.out / f"{name}.md").write_text(page(result), encoding="utf-8")
    print(page(result))


if __name__ == "__main__":
    main()
