"""Reconstructs simulated views with a method of the benchmark, and writes its table and figure to bench/results.

Run: python -m bench.reconstruction [--views 36] [--width 1920] [--scene 7] [--method stereo] [--scenario dense]
    [--out NAME]

The images are those of `bench.scenes`: without the whole protocol, with true poses, and with the simulated scan as
the ground truth. The control spheres are in images and scan.
"""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from bench.machine import REPOSITORY, RESULTS
from service.benchmark.methods import method_named, methods
from service.benchmark.running import Trial, run_trial
from service.benchmark.table import figure_png, table_markdown
from service.computations.benchmark import SCENARIOS, read_results
from tests.support.scenes.rendered_scene import CACHE, render_scene
from tests.support.scenes.simulated_data_set import simulated_data_set

WORK = REPOSITORY / "build" / "bench" / "reconstruction"


def main() -> None:
    """Run the scenarios, and keep results, table and figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--scene", type=int, default=7)
    parser.add_argument("--method", default="stereo")
    parser.add_argument("--scenario", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--out", default="reconstruction")
    args = parser.parse_args()
    dataset = simulated_data_set(render_scene(args.scene, args.width, args.views, cache=args.cache))
    work = WORK / f"scene{args.scene:02d}_{args.width}_{args.views}"
    work.mkdir(parents=True, exist_ok=True)
    for scenario in args.scenario:
        result = run_trial(Trial(method_named(args.method), scenario, work), dataset)
        print(scenario, result.score or result.failure, result.effort, flush=True)
    results = read_results(work)
    day = datetime.now(UTC).date().isoformat()
    name = RESULTS / f"{args.out}-{args.width}-{args.views}-{day}"
    lines = ",\n".join(result.model_dump_json(indent=1) for result in results)
    name.with_suffix(".json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    name.with_suffix(".md").write_text(table_markdown(results, methods()), encoding="utf-8")
    (work / "figure.png").write_bytes(figure_png(work, results, methods()))


if __name__ == "__main__":
    main()
