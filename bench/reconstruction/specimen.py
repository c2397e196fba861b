"""Scores meshes of `bench.reconstruction` once more, with the spheres and their posts cut out of mesh and truth.

Run: python -m bench.reconstruction.specimen [--views 36] [--width 1920] [--scene 7] [--work FOLDER] [--out NAME]

The data set's ground truth can be had without spheres and posts; this is the figure for such a truth. It stands
beside the figure of the whole mesh and does not replace it: the paper's supplement accumulates distances "over the
entire meshes", its text calls the truth an "anatomical mesh", and neither says whether markers are part of it.
Everything else is as for the whole: the box, the spacing and the limit of outliers. K-wires stay.
"""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bench.machine import REPOSITORY, RESULTS, commit, machine
from bench.reconstruction.simulated import simulated_data_set
from bench.scenes import CACHE, render_scene
from drivers.meshes.surface_file import read_surface_file
from service.benchmark.records import BenchmarkResult, Score, read_results
from service.benchmark.scoring import compare
from service.compute.ground_truth.fuse import Markers, compact
from service.compute.ground_truth.surface import Surface
from service.core.geometry import inverse
from service.core.units import metres
from service.dataset.records import Mesh
from simulators.scene.world import POST_RADIUS_M

WORK = REPOSITORY / "build" / "bench" / "reconstruction"
HEADING = """# With and without spheres and posts

"whole" is the score that `bench.reconstruction` kept; the same mesh was then scored with spheres and posts cut out of
it and of the truth. Machine, revision and the meshes' SHA-256 are in the .json file."""


def markers_of(folder: Path) -> tuple[Markers, Markers]:
    """Registration spheres with their posts, and control spheres, of a rendered scene; in its scan's frame."""
    spheres = json.loads((folder / "spheres.json").read_text(encoding="utf-8"))
    T_world_scan = np.array(json.loads((folder / "truth.json").read_text(encoding="utf-8"))["T_world_scan"])
    up = inverse(T_world_scan)[:3, 2]
    radius_m = metres(float(spheres["radius_mm"]))
    return (
        Markers(metres(np.array(spheres["registration_mm"])), radius_m, up, POST_RADIUS_M),
        Markers(metres(np.array(spheres["control_mm"])), radius_m, up),
    )


def specimen_of(surface: Surface, markers: tuple[Markers, ...]) -> Surface:
    """The mesh without the faces that touch a sphere or a post."""
    near = np.any([some.near(surface.vertices_m) for some in markers], axis=0)
    return compact(surface.vertices_m, surface.faces[~near[surface.faces].any(axis=1)])[0]


def score_specimen(mesh: Path, truth: Mesh, markers: tuple[Markers, ...]) -> Score:
    """Compare a mesh that `run_trial` kept (`mesh.ply`, cut to the box of the whole truth), both without markers."""
    file = read_surface_file(mesh, "m")
    bare = specimen_of(Surface(truth.vertices_m, truth.faces), markers)
    found = specimen_of(Surface(file.vertices_m, file.faces), markers)
    return compare(found, Mesh(bare.vertices_m, bare.faces)).score


def table(results: list[tuple[BenchmarkResult, Score]]) -> str:
    """Both scores of each result, as Markdown."""
    lines = [
        "| method | scenario | views | px | compared | Chamfer mm | accuracy mm | completeness mm "
        "| F 0.5 mm | F 1 mm |",
        "|---|---|---:|---:|---|---:|---:|---:|---:|---:|",
    ]
    for result, bare in results:
        for words, score in (("whole", result.score), ("spheres and posts cut out", bare)):
            if score is not None:
                lines.append(
                    f"| {result.method} | {result.scenario} | {result.views} | {result.width} | {words} "
                    f"| {score.chamfer_mm:.3f} | {score.accuracy_mm:.3f} | {score.completeness_mm:.3f} "
                    f"| {score.f_score_05:.3f} | {score.f_score_10:.3f} |"
                )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Score every kept result of a work folder without markers, and write both scores to bench/results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--scene", type=int, default=7)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--work", type=Path, help="folder of the results; that of bench.reconstruction otherwise")
    parser.add_argument("--out", default="reconstruction-specimen")
    args = parser.parse_args()
    folder = render_scene(args.scene, args.width, args.views, cache=args.cache)
    truth, markers = simulated_data_set(folder).mesh, markers_of(folder)
    work = args.work or WORK / f"scene{args.scene:02d}_{args.width}_{args.views}"
    scored: list[tuple[BenchmarkResult, Score]] = []
    for result in read_results(work):
        if result.score is not None:
            mesh = work / f"{result.method}-{result.scenario}" / "mesh.ply"
            scored.append((result, score_specimen(mesh, truth, markers)))
            print(table(scored[-1:]), flush=True)
    now = datetime.now(UTC)
    name = RESULTS / f"{args.out}-{args.width}-{args.views}-{now.date().isoformat()}"
    rows = [
        {
            "mesh_sha256": r.mesh_sha256,
            "scenario": r.scenario,
            "whole": r.score.model_dump(),
            "cut": bare.model_dump(),
        }
        for r, bare in scored
        if r.score is not None
    ]
    record = {
        "machine": machine(),
        "commit": commit(),
        "finished_utc": now.isoformat(timespec="seconds"),
        "rows": rows,
    }
    name.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    name.with_suffix(".md").write_text(f"{HEADING}\n\n{table(scored)}", encoding="utf-8")


if __name__ == "__main__":
    main()
