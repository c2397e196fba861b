"""Accuracy of the fused mesh on the simulated scene, against its true surface, with the scan's and the CT's own.

Run: python -m bench.ground_truth.fusion [--scene 7] [--voxel-mm 0.4] [--spacing-mm 0.5] [--half] [--out NAME]
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from datetime import UTC, datetime

import numpy as np

from bench.machine import RESULTS, machine
from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.distances.triangle_tree import TriangleTree
from service.compute.ground_truth.fusion.fuse import Fused, FusionSettings, Source, fuse
from service.compute.ground_truth.fusion.overlap import vertex_normals
from service.compute.ground_truth.surface import IntArray, Surface
from service.compute.surfaces.isosurface import surface
from service.core.geometry import Array, apply
from service.core.units import metres, mm
from simulators.ct_suite.volume import Grid, voxelise
from simulators.scan_station.station import scan_scene
from simulators.scene.world import Scene

LOW_M, HIGH_M = np.array([-0.165, -0.095, 0.004]), np.array([0.165, 0.095, 0.100])  # the specimen above the board
THRESHOLD_HU = -475.0
_INSIDE_M = 0.003  # from the ends of the volume, where the CT's surface is cut
_PATCH_M = 2e-3


def sources(scene: Scene, voxel_m: float, spacing_m: float, high: Array) -> tuple[Surface, Surface]:
    """The CT's surface and the scan, both in the world frame."""
    shape = tuple(int(n) for n in np.ceil((high - LOW_M) / voxel_m)[::-1])
    T = np.eye(4)
    T[:3, 3] = LOW_M
    volume = voxelise(scene, Grid(T, voxel_m, (shape[0], shape[1], shape[2])), control_spheres=False)
    T_voxel = T.copy()
    T_voxel[:3, :3] *= voxel_m
    vertices, faces = surface(volume, T_voxel, THRESHOLD_HU)
    scan = scan_scene(scene, spray=True, control_spheres=False, spacing_m=spacing_m)
    scanned = Surface(apply(scan.T_world_scan, scan.vertices_m), scan.faces.astype(np.int64))
    return Surface(vertices, faces.astype(np.int64)), scanned


def heights(truth: Surface, points: Array, normals: Array) -> Array:
    """(N,) how far points (N, 3) are outside the true surface."""
    rough = PointIndex(truth.vertices_m).nearest(points)[0]
    found = TriangleTree(truth).nearest(points, rough)
    outside = np.einsum("ni,ni->n", points - found.points_m, normals) > 0
    return np.where(outside, found.distance_m, -found.distance_m)


def seam_steps(fused: Fused, index: IntArray, height: Array) -> Array:
    """Difference of the mean error on both sides of the seam, where CT and scan count alike, in patches of 4 mm."""
    points, weight = fused.surface.vertices_m[index], fused.weight[index]
    seam = points[np.abs(weight - 0.5) < 0.05]
    seam = seam[:: max(1, len(seam) // 2000)]
    steps: list[float] = []
    for centre in seam:
        near = np.linalg.norm(points - centre, axis=1) < _PATCH_M
        above, below = near & (weight > 0.5) & (weight < 0.8), near & (weight < 0.5) & (weight > 0.2)
        if min(above.sum(), below.sum()) >= 5:
            steps.append(abs(float(height[above].mean() - height[below].mean())))
    return np.array(steps)


def rms_mm(values: Array) -> float:
    """Root mean square in millimetres."""
    return round(mm(float(np.sqrt(np.mean(values**2)))), 4)


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", type=int, default=7)
    parser.add_argument("--voxel-mm", type=float, default=0.4)
    parser.add_argument("--spacing-mm", type=float, default=0.5)
    parser.add_argument("--half", action="store_true", help="only one half of the specimen")
    parser.add_argument("--out", default="fusion")
    args = parser.parse_args()
    scene = Scene.generate(args.scene)
    high = HIGH_M * np.array([0.0 if args.half else 1.0, 1.0, 1.0])
    ct, scan = sources(scene, metres(args.voxel_mm), metres(args.spacing_mm), high)
    cpu = time.process_time()
    fused = fuse(ct, scan, np.array([0.0, 0.0, 1.0]), FusionSettings(keep_scan_only=False))
    cpu = time.process_time() - cpu
    vertices, faces = scene.solid_mesh(control_spheres=False)
    truth = Surface(vertices, faces.astype(np.int64))
    points, normals = fused.surface.vertices_m, vertex_normals(fused.surface)
    inside = np.flatnonzero(np.all((points > LOW_M + _INSIDE_M) & (points < high - _INSIDE_M), axis=1))
    height = heights(truth, points[inside], normals[inside])
    by = {s.name.lower(): rms_mm(height[fused.source[inside] == s]) for s in Source}
    steps = seam_steps(fused, inside, height)
    record = {
        "machine": machine(),
        "scene": args.scene,
        "voxel_mm": args.voxel_mm,
        "half": args.half,
        "ct_faces": len(ct.faces),
        "scan_faces": len(scan.faces),
        "fuse_cpu_s": round(cpu, 1),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "rms_mm": rms_mm(height),
        "rms_by_source_mm": by,
        "share_by_source": {s.name.lower(): round(fused.share(s), 3) for s in Source},
        "wound_share": round(float(fused.wound.mean()), 4),
        "seam_step_mm": {
            "median": round(mm(float(np.median(steps))), 4),
            "p99": round(mm(float(np.percentile(steps, 99))), 4),
            "max": round(mm(float(steps.max())), 4),
        },
        "ct_offset_mm": round(mm(fused.ct_offset_m), 4),
        "ct_spread_mm": round(mm(fused.ct_spread_m), 4),
        "folded_faces": fused.folded,
    }
    print(json.dumps(record, indent=1))
    day = datetime.now(UTC).date().isoformat()
    (RESULTS / f"{args.out}-{day}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
