"""How complete a reconstruction of simulated views can be: what of the truth enough views see, steeply or not.

Run: python -m bench.reconstruction.visible [--views 36] [--width 1920] [--scene 7] [--out NAME]

A vertex of the scan is seen by a view if nothing is before it and it faces the camera. A method that measured exactly
what N views see at up to an angle, and nothing else, would have the completeness that is written here, and on top of
it the floor of the sampling. No method of the benchmark is told anything of this.
"""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bench.machine import RESULTS, commit, machine
from service.compute.images.render import RayMesh
from service.compute.surfaces.surface import IntArray, PointIndex, Surface
from service.core.geometry import Array, apply, inverse
from service.core.units import mm
from service.dataset.records import DataSet
from tests.support.scenes.rendered_scene import CACHE, render_scene
from tests.support.scenes.simulated_data_set import simulated_data_set

ANGLES_DEG = (60.0, 70.0, 75.0, 80.0, 87.0)  # between the surface's normal and the ray
VIEWS = (1, 2, 4)
_POINTS = 150_000
_BEFORE_M = 2e-3  # a surface that is nearer to the camera than this hides a point


def incidence(dataset: DataSet, chosen: IntArray) -> Array:
    """(K, views) cosine between normal and ray at chosen vertices of the truth; -1 where a view sees none."""
    mesh = Surface(dataset.mesh.vertices_m, dataset.mesh.faces)
    rays = RayMesh(mesh.vertices_m, mesh.faces)
    points, normals = mesh.vertices_m[chosen], mesh.vertex_normals[chosen]
    middles = mesh.vertices_m[mesh.faces].mean(axis=1)
    out = np.full((len(chosen), len(dataset.views)), -1.0)
    for k, view in enumerate(dataset.views):
        eye = view.T_world_camera[:3, 3]
        ray = points - eye
        distance = np.linalg.norm(ray, axis=1)
        ray /= distance[:, None]
        pixels = view.camera.project(apply(inverse(view.T_world_camera), points))
        met = rays.first_face(eye, np.ascontiguousarray(ray, dtype=np.float32))
        seen = ((pixels > 0) & (pixels < np.array([view.camera.width, view.camera.height]) - 1)).all(axis=1) & (
            met >= 0
        )
        seen &= np.linalg.norm(middles[np.maximum(met, 0)] - eye, axis=1) > distance - _BEFORE_M
        out[seen, k] = -np.einsum("ni,ni->n", ray, normals)[seen]
    return out


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--scene", type=int, default=7)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--out", default="reconstruction-visible")
    args = parser.parse_args()
    dataset = simulated_data_set(render_scene(args.scene, args.width, args.views, cache=args.cache))
    count = len(dataset.mesh.vertices_m)
    chosen = np.sort(np.random.default_rng(0).choice(count, min(count, _POINTS), replace=False))
    points, cosine = dataset.mesh.vertices_m[chosen], incidence(dataset, chosen)
    rows = ["| seen at up to | by views | share | completeness mm |", "|---|---:|---:|---:|"]
    for angle in ANGLES_DEG:
        views = (cosine > np.cos(np.radians(angle))).sum(axis=1)
        for least in VIEWS:
            seen = views >= least
            lacks_m = PointIndex(points[seen]).nearest(points[~seen])[0]
            rows.append(
                f"| {angle:g}° | {least} | {seen.mean():.3f} | {mm(float(lacks_m.sum())) / len(points):.3f} |"
            )
    text = "\n".join(rows) + "\n"
    print(text)
    record = {"machine": machine(), "commit": commit(), "scene": args.scene, "views": args.views, "rows": rows[2:]}
    name = RESULTS / f"{args.out}-{args.width}-{args.views}-{datetime.now(UTC).date().isoformat()}"
    name.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    about = (
        f"# How complete {args.views} views can be\n\nScene {args.scene}; `python -m bench.reconstruction.visible`."
    )
    name.with_suffix(".md").write_text(f"{about} Without the floor of the sampling.\n\n{text}", encoding="utf-8")


if __name__ == "__main__":
    main()
