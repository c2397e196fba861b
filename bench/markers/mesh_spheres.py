"""Spheres in meshes: accuracy, consistency of the covariances, missed and false detections; time and memory by size.

Run: python -m bench.markers.mesh_spheres [--seeds N] [--faces 1 5 20] [--out FILE]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

from service.compute.surfaces.mesh_spheres import locate_spheres
from service.core.errors import ComputeError
from tests.support.scenes.sphere_meshes import RADIUS_M, MeshBuilder, cap, clutter, scattered_centres

# name: half angle of the caps (°), white and correlated noise (m), correlation length (m), subdivisions, cloud
CASES: dict[str, tuple[float, float, float, float, int, bool]] = {
    "150°, white 0.05 mm": (150, 5e-5, 0.0, 4e-3, 4, False),
    "90°, white 0.05 mm, coarse": (90, 5e-5, 0.0, 4e-3, 3, False),
    "90°, 0.05 mm and shared 0.05 mm over 4 mm": (90, 5e-5, 5e-5, 4e-3, 4, False),
    "60°, 0.05 mm and shared 0.05 mm over 2 mm": (60, 5e-5, 5e-5, 2e-3, 4, False),
    "60°, 0.03 mm and shared 0.1 mm over 5 mm": (60, 3e-5, 1e-4, 5e-3, 4, False),
    "60°, white 0.3 mm": (60, 3e-4, 0.0, 4e-3, 5, False),
    "45°, white 0.1 mm": (45, 1e-4, 0.0, 4e-3, 4, False),
    "30°, white 0.05 mm": (30, 5e-5, 0.0, 4e-3, 5, False),
    "60°, white 0.1 mm, points only": (60, 1e-4, 0.0, 4e-3, 4, True),
}


def accuracy(name: str, seeds: int) -> dict[str, float | str]:
    """One case over several seeds of eight spheres among clutter."""
    half_deg, white, shared, length, level, cloud = CASES[name]
    squares: list[float] = []
    errors: list[float] = []
    missed = false = 0
    started = time.process_time()
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        centres = scattered_centres(rng, 8)
        built = clutter(rng, white)
        for centre in centres:
            built.add(
                *cap(centre, np.deg2rad(half_deg), rng, level=level, white_m=white, shared_m=shared, length_m=length)
            )
        vertices, faces = built.build()
        try:
            spheres = locate_spheres(vertices, faces[:0] if cloud else faces, RADIUS_M)
        except ComputeError:
            missed += len(centres)
            continue
        seen: set[int] = set()
        for sphere in spheres:
            distance = np.linalg.norm(centres - sphere.centre_m, axis=1)
            nearest = int(distance.argmin())
            if distance[nearest] > 2e-3:
                false += 1
                continue
            seen.add(nearest)
            error = sphere.centre_m - centres[nearest]
            errors.append(float(np.linalg.norm(error)))
            squares.append(float(error @ np.linalg.solve(sphere.covariance, error)))
        missed += len(centres) - len(seen)
    return {
        "case": name,
        "spheres": len(errors),
        "missed": missed,
        "false": false,
        "error_rms_mm": round(1e3 * float(np.sqrt(np.mean(np.square(errors)))), 4),
        "error_max_mm": round(1e3 * max(errors), 4),
        "chi2_per_dof": round(float(np.mean(squares)) / 3, 2),
        "within_3_sigma": round(float(np.mean(np.array(squares) < 14.16)), 4),
        "cpu_s_per_mesh": round((time.process_time() - started) / seeds, 2),
    }


def size(million_faces: int) -> dict[str, float]:
    """Time and memory for a large mesh: a wavy plane with spheres on it."""
    rng = np.random.default_rng(0)
    built = MeshBuilder()
    centres = scattered_centres(rng, 10)
    for centre in centres:
        built.add(*cap(centre, np.deg2rad(100), rng, level=6 if million_faces < 10 else 7))
    n = int(np.sqrt(million_faces * 5e5)) + 1
    x = np.linspace(-0.35, 0.35, n, dtype=np.float32)
    X, Y = np.meshgrid(x, x)
    Z = 0.006 * np.sin(40 * X) * np.cos(35 * Y) + rng.normal(0, 3e-5, X.shape).astype(np.float32)
    i = np.arange(n * n, dtype=np.int32).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    sphere_vertices, sphere_faces = built.build()
    vertices = np.concatenate([np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1), sphere_vertices])
    faces = np.concatenate(
        [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1), (sphere_faces + n * n).astype(np.int32)]
    )
    del a, b, c, d, i, X, Y, Z
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = time.perf_counter(), time.process_time()
    spheres = locate_spheres(vertices.astype(np.float64), faces, RADIUS_M, expected=len(centres))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    distance = [float(np.linalg.norm(centres - s.centre_m, axis=1).min()) for s in spheres]
    return {
        "million_faces": round(len(faces) / 1e6, 2),
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "memory_beyond_mesh_mb": round((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024),
        "error_max_mm": round(1e3 * max(distance), 4),
    }


def main() -> None:
    """Print both tables as JSON lines, and write them with --out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--faces", type=int, nargs="*", default=[1, 5, 20], help="millions")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    # Ascending, because each size raises the peak memory reported for those after it.
    sizes = [size(million) for million in sorted(args.faces)]
    cases = [accuracy(name, args.seeds) for name in CASES] if args.seeds else []
    for row in (*sizes, *cases):
        print(json.dumps(row, ensure_ascii=False))
    if args.out is not None:
        args.out.write_text(json.dumps({"sizes": sizes, "cases": cases}, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
