"""Accuracy of the fused mesh on simulated scenes, against their true surface, with the scan's and the CT's own.

Run: python -m bench.ground_truth.fusion [--scenes 7 …] [--voxel-mm 0.4] [--spacing-mm 0.5] [--half] [--out NAME]

`tests.support.scenes.seam` says how the step at the seam is measured. The same is measured in the scan's own part,
where there is no seam: what is found there is noise.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.machine import RESULTS, commit, machine
from service.compute.surfaces.fuse import FusionSettings, Source, fuse
from service.compute.surfaces.isosurface import surface
from service.compute.surfaces.surface import PointIndex, Surface, TriangleTree
from service.core.geometry import Array, apply
from service.core.units import metres, mm
from simulators.ct_suite.volume import Grid, voxelise
from simulators.scan_station.station import scan_scene
from simulators.scene.world import Scene
from tests.support.scenes.seam import no_seam, seam, steps, strips

LOW_M, HIGH_M = np.array([-0.165, -0.095, 0.004]), np.array([0.165, 0.095, 0.100])  # the specimen above the board
THRESHOLD_HU = -475.0
_INSIDE_M = 0.003  # from the ends of the volume, where the CT's surface is cut
STRIPS_M = (2e-3, 5e-3)  # radii about places on the seam
FIT_M = 3e-3
_FAR_M = 5e-4


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


def rms_mm(values: Array) -> float:
    """Root mean square in millimetres."""
    return round(mm(float(np.sqrt(np.mean(values**2)))), 4)


def largest(points: Array, height: Array, source: NDArray[np.uint8]) -> dict[str, Any]:
    """The largest error with its place and source, and each source's share of errors over half a millimetre."""
    worst = int(np.abs(height).argmax())
    far = np.abs(height) > _FAR_M
    return {
        "error_mm": round(mm(float(height[worst])), 3),
        "place_mm": [round(mm(float(x)), 1) for x in points[worst]],
        "source": Source(int(source[worst])).name.lower(),
        "share_over_half_mm": {s.name.lower(): round(float(np.mean(far[source == s])), 6) for s in Source},
    }


def measured(seed: int, voxel_m: float, spacing_m: float, high: Array) -> dict[str, Any]:
    """Fuse one scene, and compare the result with its true surface."""
    scene = Scene.generate(seed)
    ct, scan = sources(scene, voxel_m, spacing_m, high)
    cpu = time.process_time()
    fused = fuse(ct, scan, np.array([0.0, 0.0, 1.0]), FusionSettings(keep_scan_only=False))
    cpu = time.process_time() - cpu
    vertices, faces = scene.solid_mesh(control_spheres=False)
    points, normals = fused.surface.vertices_m, fused.surface.vertex_normals
    inside = np.flatnonzero(np.all((points > LOW_M + _INSIDE_M) & (points < high - _INSIDE_M), axis=1))
    points, normals, weight = points[inside], normals[inside], fused.weight[inside]
    height = heights(Surface(vertices, faces.astype(np.int64)), points, normals)
    lines = {"seam": seam(points, weight, FIT_M), "scan_alone": no_seam(points, weight, FIT_M)}
    return {
        "scene": seed,
        "ct_faces": len(ct.faces),
        "scan_faces": len(scan.faces),
        "fuse_cpu_s": round(cpu, 1),
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "rms_mm": rms_mm(height),
        "rms_by_source_mm": {s.name.lower(): rms_mm(height[fused.source[inside] == s]) for s in Source},
        "largest": largest(points, height, fused.source[inside]),
        "share_by_source": {s.name.lower(): round(fused.share(s), 3) for s in Source},
        "wound_share": round(float(fused.wound.mean()), 4),
        "step_mm": {name: steps(points, normals, height, line, FIT_M).told() for name, line in lines.items()},
        "strips_mm": {
            name: {f"{2 * mm(r):g} mm": strips(points, height, line, r) for r in STRIPS_M}
            for name, line in lines.items()
        },
        "ct_offset_mm": round(mm(fused.ct_offset_m), 4),
        "ct_spread_mm": round(mm(fused.ct_spread_m), 4),
        "folded_faces": fused.folded,
    }


def main() -> None:
    """Measure, print and write the result; after each scene, so that an interruption loses little."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[7], metavar="SEED")
    parser.add_argument("--voxel-mm", type=float, default=0.4)
    parser.add_argument("--spacing-mm", type=float, default=0.5)
    parser.add_argument("--half", action="store_true", help="only one half of the specimen")
    parser.add_argument("--out", default="fusion")
    args = parser.parse_args()
    high = HIGH_M * np.array([0.0 if args.half else 1.0, 1.0, 1.0])
    revision, day = commit(), datetime.now(UTC).date().isoformat()
    scenes: list[dict[str, Any]] = []
    for seed in args.scenes:
        scenes.append(measured(seed, metres(args.voxel_mm), metres(args.spacing_mm), high))
        print(json.dumps(scenes[-1], indent=1), flush=True)
        record = {
            "machine": machine(),
            "commit": revision,
            "voxel_mm": args.voxel_mm,
            "half": args.half,
            "scenes": scenes,
        }
        (RESULTS / f"{args.out}-{day}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
