"""Speed and memory of depth and normals at 60 megapixels, and those of raw embreex on the same rays."""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # must be set before numpy loads its libraries
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from bench.machine import commit, machine
from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, pixel_rays, seen, seen_rows
from service.core.geometry import Array, Transform, look_at

RESULTS = Path(__file__).parents[1] / "results"
SIZE = (9504, 6336)
LEAST_SHARE, MOST_GIB = 0.80, 2.0
PINHOLE = CameraModel(*SIZE, 13000.0, 13000.0, 4751.5, 3167.5)
DISTORTED = CameraModel(*SIZE, 13000.0, 13000.0, 4751.5, 3167.5, -0.08, 0.05, 1e-4, -2e-4)


def relief(side: int) -> tuple[Array, NDArray[np.int64]]:
    """A bumpy surface of 0.5 × 0.36 m: vertices (side², 3) and about 2 side² faces."""
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, side), np.linspace(-0.18, 0.18, side))
    z = 0.02 * np.sin(40 * x) * np.cos(31 * y) + 0.003 * np.sin(400 * x)
    k = np.arange(side * side).reshape(side, side)
    a, b, c, d = k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (d, c, b))])
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), faces


def main() -> None:
    """Measure both cameras and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=1001, help="vertices along each side of the mesh")
    parser.add_argument("--tiles", type=int, default=0, help="measure only so many tiles; 0: the whole image")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    vertices, faces = relief(options.side)
    T = look_at(np.array([0.05, -0.1, 0.62]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    surface = RayMesh(vertices, faces)
    scene = EmbreeScene()
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
    rows = {
        name: speed(scene, surface, camera, T, options.tiles)
        for name, camera in (("pinhole", PINHOLE), ("distorted", DISTORTED))
    }
    del scene
    peak_gib = whole_image_gib(surface, T) if not options.tiles else None
    report(options, len(faces), rows, peak_gib)


def speed(scene: Any, surface: RayMesh, camera: CameraModel, T: Transform, most: int) -> dict[str, float]:
    """Millions of rays per CPU second: embreex alone, and depth with normals, tile by tile in turn."""
    spent = dict.fromkeys(("raw", "raw_all_outputs", "ours"), 0.0)
    rays, count = pixel_rays(camera), 0
    tiles = seen_rows(surface, camera, T)
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # builds its tree
    begin = time.process_time()
    for tile in tiles:
        spent["ours"] += time.process_time() - begin
        n = len(tile.depth_m)
        xy = rays.xy(tile.first, tile.first + n)
        z_one = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2).reshape(-1, 3)
        directions = np.ascontiguousarray(z_one @ T[:3, :3].T, dtype=np.float32)
        origins = np.broadcast_to(T[:3, 3].astype(np.float32), directions.shape).copy()
        begin = time.process_time()
        scene.run(origins, directions)
        middle = time.process_time()
        scene.run(origins, directions, output=True)
        spent["raw_all_outputs"] += time.process_time() - middle
        spent["raw"] += middle - begin
        count += len(directions)
        if most and tile.first >= (most - 1) * n:
            break
        begin = time.process_time()
    return {name: count / seconds / 1e6 for name, seconds in spent.items()} | {"rays": count}


def whole_image_gib(surface: RayMesh, T: Transform) -> float:
    """Peak memory of this process after a whole image of depth and normals."""
    seen(surface, DISTORTED, T)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def report(
    options: argparse.Namespace, faces: int, rows: dict[str, dict[str, float]], peak_gib: float | None
) -> None:
    """Print and write what was measured."""
    share = {name: row["ours"] / row["raw"] for name, row in rows.items()}
    here = machine()
    memory = "not measured" if peak_gib is None else f"{peak_gib:.2f} GiB (limit {MOST_GIB:.0f} GiB)"
    lines = [
        f"| {name} | {row['rays'] / 1e6:.1f} | {row['raw']:.2f} | {row['raw_all_outputs']:.2f} | {row['ours']:.2f} "
        f"| {100 * share[name]:.0f} % |"
        for name, row in rows.items()
    ]
    text = f"""# Depth and normals beside raw embreex

{here["processor"]}, {here["cores"]} cores, shared with other work; revision {commit()}.
A mesh of {faces} triangles, images of {SIZE[0]} × {SIZE[1]} px. Millions of rays per CPU second of one thread,
measured tile by tile in turn. `raw`: embreex with prepared rays, index of the face only; `all outputs`: the same with
distance, face and barycentric coordinates. `ours`: rays made, cast, depth and normals in double precision. At least
{100 * LEAST_SHARE:.0f} % of `raw` is required.

| camera | Mrays | raw | all outputs | ours | ours / raw |
|---|---:|---:|---:|---:|---:|
{chr(10).join(lines)}

Peak memory of the process with mesh, tree, whole depth and whole normals: {memory}.
"""
    options.out.mkdir(parents=True, exist_ok=True)
    name = f"pixel_depth-{datetime.now(UTC):%Y-%m-%d}"
    document = {"machine": here, "faces": faces, "size": SIZE, "mrays_per_cpu_s": rows, "peak_gib": peak_gib}
    (options.out / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    (options.out / f"{name}.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
