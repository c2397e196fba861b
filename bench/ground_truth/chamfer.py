"""Time and memory of the nearest neighbours of a Chamfer distance, compared with k-d tree libraries.

Run: python -m bench.ground_truth.chamfer [--millions 2] [--times 2] [--out NAME]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime

import numpy as np
from pykdtree.kdtree import KDTree
from scipy.spatial import cKDTree

from bench.machine import RESULTS, machine
from service.compute.surfaces.chamfer import chamfer, sample
from service.compute.surfaces.surface import PointIndex, Surface
from service.core.geometry import Array
from service.core.units import mm

SPACING_M = 1e-4
LIMIT = 1.2  # times the fastest library


def surface(points: int, noise_m: float, seed: int) -> Surface:
    """A wavy square, in a grid of 0.3 mm, that gives so many samples."""
    side = np.sqrt(points) * SPACING_M
    n = round(side / 3e-4)
    x, y = np.meshgrid(*[np.linspace(0, side, n + 1)] * 2, indexing="ij")
    rng = np.random.default_rng(seed)
    z = 0.004 * np.sin(x / 0.007) * np.cos(y / 0.009) + rng.normal(0, noise_m, x.shape)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Surface(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), faces)


def ours(a: Array, b: Array) -> Array:
    """Mean distance in each direction (2,), by the program's own index."""
    return np.array([PointIndex(b).nearest(a)[0].mean(), PointIndex(a).nearest(b)[0].mean()])


def scipy_tree(a: Array, b: Array) -> Array:
    """Mean distance in each direction (2,), by SciPy's k-d tree on all cores."""
    return np.array([np.mean(cKDTree(y).query(x, workers=-1)[0]) for x, y in ((a, b), (b, a))], dtype=np.float64)


def pykdtree_tree(a: Array, b: Array) -> Array:
    """Mean distance in each direction (2,), by pykdtree with its defaults."""
    return np.array([KDTree(b).query(a)[0].mean(), KDTree(a).query(b)[0].mean()])


WAYS: dict[str, Callable[[Array, Array], Array]] = {"pykdtree": pykdtree_tree, "scipy": scipy_tree, "ours": ours}


def measured(a: Array, b: Array, times: int) -> dict[str, dict[str, float]]:
    """Least wall and CPU seconds of each way, in turns, because other processes disturb; all must agree."""
    out = {name: {"wall_s": np.inf, "cpu_s": np.inf} for name in WAYS}
    means: list[Array] = []
    for _ in range(times):
        for name, way in WAYS.items():
            wall, cpu = time.perf_counter(), time.process_time()
            means.append(way(a, b))
            took = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
            out[name] = {unit: round(min(best, took[unit]), 2) for unit, best in out[name].items()}
            print(name, out[name], flush=True)
    if not all(np.allclose(mean, means[0], rtol=1e-9) for mean in means):
        raise SystemExit(f"the trees disagree: {means}")
    return out


def main() -> None:
    """Measure samples in the order of the faces and in random order, and one whole score with its memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--millions", type=float, default=2.0)
    parser.add_argument("--times", type=int, default=2, help="each way, of which the fastest counts")
    parser.add_argument("--out", default="chamfer")
    args = parser.parse_args()
    points = round(1e6 * args.millions)
    rng = np.random.default_rng(0)
    pred, gt = surface(points, 3e-5, 1), surface(points, 0.0, 0)
    a, b = sample(pred, SPACING_M, rng).points_m, sample(gt, SPACING_M, rng).points_m
    orders = {"order of the faces": (a, b), "random order": (rng.permutation(a), rng.permutation(b))}
    times = {name: measured(*both, args.times) for name, both in orders.items()}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    del orders
    cpu = time.process_time()
    score = chamfer(pred, gt)
    whole = {
        "cpu_s": round(time.process_time() - cpu, 1),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "peak_memory_before_mb": round(before / 1024),
        "chamfer_mm": round(mm(score.chamfer_m), 4),
        "floor_mm": round(mm(score.floor_m), 4),
    }
    record = {"machine": machine(), "points": [len(a), len(b)], "limit": LIMIT, "trees": times, "whole_score": whole}
    day = datetime.now(UTC).date().isoformat()
    (RESULTS / f"{args.out}-{day}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    (RESULTS / f"{args.out}-{day}.md").write_text(_page(record, times, whole), encoding="utf-8")


def _page(
    record: Mapping[str, object], times: dict[str, dict[str, dict[str, float]]], whole: dict[str, float]
) -> str:
    rows: list[str] = []
    for order, by in times.items():
        fastest = min(by["pykdtree"]["cpu_s"], by["scipy"]["cpu_s"])
        rows += [
            f"| {order} | {n} | {t['wall_s']} | {t['cpu_s']} | {t['cpu_s'] / fastest:.2f} |" for n, t in by.items()
        ]
    return "\n".join(
        [
            "# Nearest neighbours of a Chamfer distance",
            "",
            f"{record['points']} samples at 0.1 mm, both directions, trees built in the time. `ours` must take at",
            f"most {LIMIT} times as long as the fastest library. The machine was shared; CPU seconds count.",
            "Each was measured several times in turn; the table has the smallest value.",
            "",
            "| samples in | tree | wall s | CPU s | to the fastest library |",
            "|---|---|---:|---:|---:|",
            *rows,
            "",
            f"The whole score, with sampling, distances to the faces and normals: {whole['cpu_s']} CPU s; the",
            f"process peaked at {whole['peak_memory_mb']} MB, {whole['peak_memory_before_mb']} MB of which were",
            "reached before. Chamfer",
            f"distance {whole['chamfer_mm']} mm, floor {whole['floor_mm']} mm.",
            "",
        ]
    )


if __name__ == "__main__":
    main()
