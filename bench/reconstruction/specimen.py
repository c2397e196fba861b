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

from bench.machine import REPOSITORY, RESULTS, commit, machine
from service.computations.benchmark import BenchmarkResult, Score, read_results
from tests.support.scenes.rendered_scene import CACHE, render_scene
from tests.support.scenes.simulated_data_set import simulated_data_set
from tests.support.scenes.specimen import markers_of, score_specimen

WORK = REPOSITORY / "build" / "bench" / "reconstruction"
HEADING = """# With and without spheres and posts

"whole" is the score that `bench.reconstruction` kept; the same mesh was then scored with spheres and posts cut out of
it and of the truth. Machine, revision and the meshes' SHA-256 are in the .json file."""


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
