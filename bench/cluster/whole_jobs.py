"""A registration of 1,000 views, and depth maps of 60 megapixels, over 1, 2 and 4 workers of a Dask cluster.

`python -m bench.cluster.whole_jobs` takes a quarter of an hour on two quiet cores. The registration is the whole one,
from files: 20 rendered photographs under 1,000 names, each decoded and searched by itself; its joint solution is one
process. The depth maps are those of an export for nerfstudio, with the undistorted photographs that go with them.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.cluster.tasks import connect, full_size_data_set, grow
from bench.machine import RESULTS, commit, machine
from bench.registration.register_scale import locate_and_register
from service.dataset.exporter import exporter, write_data_set
from service.machine.executors import computing_at
from service.machine.schedulers import Scheduler
from tests.support.processes.cluster import dask_cluster
from tests.support.scenes.rendered_scene import rendered

_SCENE = "scene01_1920_20"
_FACES = 1_000_000
_WIDTHS = (1, 2, 4)  # numbers of workers


def measure(folder: Path, views: int, maps: int) -> dict[int, dict[str, float]]:
    """Return the wall times of both jobs by the number of workers."""
    scene = rendered(_SCENE)
    data = full_size_data_set(folder, maps, _FACES)
    took: dict[int, dict[str, float]] = {}
    own = folder / "cluster"
    own.mkdir()
    with dask_cluster(own, workers=0) as cluster:
        for workers in _WIDTHS:
            grow(cluster, workers)
            with computing_at(Scheduler(cluster.address, patience_s=90.0)):
                connect(2)
                found = locate_and_register(scene, views, 2)
                begin = time.perf_counter()
                write_data_set(data, exporter("nerfstudio"), folder / f"out{workers}", processes=2)
                export_s = time.perf_counter() - begin
            took[workers] = {
                "outlines_s": float(str(found["locate_s"])),
                "solution_s": float(str(found["solve_s"])),
                "rms_px": float(str(found["rms_px"])),
                "export_s": export_s,
            }
    return took


def page(result: Mapping[str, Any]) -> str:
    """Return the result as a page."""
    one = result["took"]["1"]
    whole_s = one["outlines_s"] + one["solution_s"]
    rows = "\n".join(
        f"| {workers} | {row['outlines_s']:.1f} | {row['solution_s']:.1f} "
        f"| {whole_s / (row['outlines_s'] + row['solution_s']):.2f} | {row['rms_px']:.4f} "
        f"| {row['export_s']:.1f} | {one['export_s'] / row['export_s']:.2f} |"
        for workers, row in result["took"].items()
    )
    about = result["machine"]
    return f"""# Whole jobs over the workers of a cluster

{about["processor"]}, {about["cores"]} hyperthreads of one core, load {result["load"]} at the end; revision
{result["commit"]}. A registration of {result["views"]} views of 1920 px from files, and an export of {result["maps"]}
views of 60 megapixels with their depth maps (a mesh of {_FACES / 1e6:.0f} M faces). Scheduler and workers are
processes of this machine; one turn each.

| Dask workers | outlines, s | joint solution, s | times one worker | residual, px | export, s | times one worker |
|---:|---:|---:|---:|---:|---:|---:|
{rows}

What bounds it: the one core here, so that four workers share what two have. With a core for each worker the joint
solution, which is one process, bounds a registration: it is {100 * one["solution_s"] / whole_s:.0f} % of one worker's
time, so that no number of workers is more than {whole_s / one["solution_s"]:.0f} times as fast. What a link adds is
calculated in [cluster_tasks](cluster_tasks-2026-11-28.md).
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--maps", type=int, default=8)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        took = measure(Path(folder), options.views, options.maps)
    result: dict[str, Any] = {
        "views": options.views,
        "maps": options.maps,
        "took": {str(workers): {name: round(s, 4) for name, s in row.items()} for workers, row in took.items()},
        "commit": commit(),
        "machine": machine(),
        "load": round(os.getloadavg()[0], 1),
    }
    stem = options.results / f"cluster_whole_jobs-{datetime.now(UTC).date().isoformat()}"
    stem.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    stem.with_suffix(".md").write_text(page(result), encoding="utf-8")
    print(page(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
