"""Peak memory and time of the jobs that compute on surfaces, at the size of the paper's protocol.

Run: python -m bench.whole_runs.job_memory [--limit-gb 1.5] [--voxel-mm 0.4] [--spacing-mm 0.5] [--jobs fuse …]
     [--before CHECKOUT --rounds 3]

With `--before` each job is computed in turn by the program of another checkout and by this one, and their medians,
the ratio of them and whether both gave the same files are reported.

Each job is computed in a process of its own, under a hard limit of its memory (RLIMIT_DATA: all that it allocates,
without the pages of mapped files) and with the allocator set as a worker sets it. The volume is that of the whole
board with its spheres and posts; the scan is that of the same scene. The inputs are made once, and kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from bench.machine import REPOSITORY, RESULTS, commit, machine
from service.computations import fuse
from service.computations.job import JobAnswer, JobContext, RecordedContext, handler_of
from service.computations.live import COVERAGE_POINTS
from service.computations.scans import CT_SURFACE, LOCATE_SPHERES
from service.compute.surfaces.surface import Surface, read_ply
from service.core.records.base import ArtefactRef
from service.core.units import metres
from service.machine.resources import keep_freed_memory
from service.store.artefacts import hash_file
from simulators.ct_suite.volume import grid_around, voxelise
from simulators.scan_station.station import scan_scene
from simulators.scene.world import Scene

CACHE = REPOSITORY / "build" / "bench" / "job_memory"
SCENE, RADIUS_M, THRESHOLD_HU = 7, 0.015, -450
KINDS = {kind.name: kind for kind in (CT_SURFACE, COVERAGE_POINTS, LOCATE_SPHERES, fuse.KIND)}
SCORING = "benchmark scoring"


@dataclass(frozen=True, slots=True)
class Folder:
    """A store for one job: its inputs by name, and what it gives."""

    folder: Path

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """The file of this name."""
        return self.folder / sha256

    def put_bytes(self, data: bytes, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep bytes under their original name."""
        (self.folder / original_name).write_bytes(data)
        sha256 = hashlib.sha256(data).hexdigest()
        return ArtefactRef(
            sha256=sha256, kind=kind, media_type=media_type, size_bytes=len(data), original_name=original_name
        )

    def put_file(self, path: Path, *, kind: str, media_type: str, original_name: str) -> ArtefactRef:
        """Keep a file under its original name."""
        shutil.copyfile(path, self.folder / original_name)
        sha256, size = hash_file(path)
        return ArtefactRef(
            sha256=sha256, kind=kind, media_type=media_type, size_bytes=size, original_name=original_name
        )


def make_inputs(folder: Path, voxel_m: float, spacing_m: float) -> None:
    """Write the volume and the scan, unless they are there."""
    if (folder / "inputs.json").is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    scene = Scene.generate(SCENE)
    grid = grid_around(scene, np.eye(4), voxel_m, control_spheres=True)
    np.save(folder / "hounsfield.npy", voxelise(scene, grid, control_spheres=True))
    T_ct_voxel = grid.T_world_grid.copy()
    T_ct_voxel[:3, :3] *= voxel_m
    scan = scan_scene(scene, spray=True, control_spheres=False, spacing_m=spacing_m)
    np.savez(folder / "scan.npz", vertices_m=scan.vertices_m, faces=scan.faces.astype(np.int32))
    inputs = {
        "T_ct_voxel": T_ct_voxel.tolist(),
        "voxels": int(np.prod(grid.shape)),
        "scan_faces": len(scan.faces),
        "T_world_scan": scan.T_world_scan.tolist(),
    }
    (folder / "inputs.json").write_text(json.dumps(inputs), encoding="utf-8")


def arguments(folder: Path, name: str) -> dict[str, Any]:
    """The arguments of a job, with what the earlier ones gave."""
    inputs = json.loads((folder / "inputs.json").read_bytes())
    if name == "ct_surface":
        return {"radius_m": RADIUS_M, "expected": 13, "hounsfield": "hounsfield.npy", "measure_cut": True,
                "T_ct_voxel": inputs["T_ct_voxel"], "threshold_hu": THRESHOLD_HU}  # fmt: skip
    if name == "locate_spheres":
        return {"mesh": "scan.npz", "radius_m": RADIUS_M, "expected": 10}
    ct = json.loads((folder / "ct_surface.json").read_bytes())["answer"]
    if name == "coverage_points":
        limits = {"min_views": 2, "max_angle_deg": 65.0, "max_distance_m": 1.0}
        return {"mesh": "ct_surface.npz", "spheres_m": ct["spheres_m"], "radius_m": RADIUS_M, "limits": limits}
    scan = json.loads((folder / "locate_spheres.json").read_bytes())["answer"]
    return {"ct_mesh": "ct_surface.npz", "scan_mesh": "scan.npz", "ct": ct, "scan": scan, "radius_m": RADIUS_M,
            "blend_m": 0.003, "spacing_m": 0.0001}  # fmt: skip


def score(folder: Path) -> JobAnswer:
    """Score a mesh against the fused one as a benchmark does: the same with noise."""
    from service.benchmark.running import score_mesh, write_scored  # noqa: PLC0415 - loads much that jobs do not need
    from service.dataset.records import Mesh  # noqa: PLC0415

    columns, faces = read_ply(folder / "ground_truth.ply")
    vertices = 1e-3 * np.stack([columns[name] for name in "xyz"], axis=1).astype(np.float64)
    truth = Mesh(vertices, faces)
    found = Surface(vertices + np.random.default_rng(0).normal(0, 3e-5, vertices.shape), faces)
    scored = score_mesh(found, truth)
    assert write_scored
    return JobAnswer({"chamfer_mm": scored.score.chamfer_mm, "faces": float(len(faces))})


def compute(folder: Path, name: str, limit_gb: float) -> dict[str, Any]:
    """Compute a job in this process under the limit; what it took, and what it measured."""
    keep_freed_memory()
    untouched_kb = _status_kb("VmData") - _status_kb("RssAnon")  # such as the stacks of threads
    bound = int(limit_gb * 1e9) + 1024 * untouched_kb
    resource.setrlimit(resource.RLIMIT_DATA, (bound, bound))
    began_s = time.monotonic()
    if name == SCORING:
        answer = score(folder)
    else:
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            given = arguments(folder, name)
            context: RecordedContext = JobContext(given, Folder(folder), Path(scratch), lambda *_: None)
            answer = handler_of(KINDS[name])(context)
    took_s = time.monotonic() - began_s
    record = {"measures": dict(answer.measures), "answer": answer.result}
    (folder / f"{name}.json").write_text(json.dumps(record), encoding="utf-8")
    used = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "job": name,
        "peak_mb": round(used.ru_maxrss / 1e3),
        "seconds": round(took_s, 1),
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "of_the_system_s": round(used.ru_stime, 1),
        "measures": {key: round(value, 5) for key, value in answer.measures.items()},
    }


def _status_kb(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def alone(name: str, options: argparse.Namespace, checkout: Path = REPOSITORY) -> dict[str, Any]:
    """Compute a job in a process of its own, by the program of a checkout; what it took, or how it failed."""
    command = [sys.executable, "-m", "bench.whole_runs.job_memory", "--alone", name,
               "--limit-gb", str(options.limit_gb), "--cache", str(options.cache.absolute())]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    found = json.loads(lines[-1]) if done.returncode == 0 else {"job": name, "failed": done.stderr[-500:]}
    print(json.dumps(found), flush=True)
    return found


def compared(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Compute a job by both checkouts in turn; the medians of each, their ratios, and which files were the same."""
    rounds: dict[str, list[dict[str, Any]]] = {"before": [], "after": []}
    files: dict[str, dict[str, str]] = {"before": {}, "after": {}}
    for _ in range(options.rounds):
        for which, checkout in (("before", options.before.absolute()), ("after", REPOSITORY)):
            began_s = time.time()
            rounds[which].append(alone(name, options, checkout))
            made = (path for path in options.cache.iterdir() if path.is_file() and path.stat().st_mtime >= began_s)
            files[which] |= {path.name: hash_file(path)[0] for path in made}
    failed = [one["failed"] for of in rounds.values() for one in of if "failed" in one]
    if failed:
        return {"job": name, "failed": failed[0], "rounds": rounds}
    figures = ("cpu_s", "of_the_system_s", "seconds", "peak_mb")
    medians = {
        which: {key: median(one[key] for one in of if key in one) for key in figures if key in of[0]}
        for which, of in rounds.items()
    }
    ratios = {key: round(medians["after"][key] / value, 3) for key, value in medians["before"].items()}
    same = sorted(name for name in files["after"] if files["after"][name] == files["before"].get(name))
    others = sorted(set(files["after"]) - set(same))
    return {"job": name, "medians": medians, "ratios": ratios, "same": same, "others": others, "rounds": rounds}


def main() -> int:
    """Compute each job in a process of its own, print and write the figures; returns 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    every = ["ct_surface", "locate_spheres", "coverage_points", "fuse", SCORING]
    parser.add_argument("--jobs", nargs="+", default=every, choices=every)
    parser.add_argument("--limit-gb", type=float, default=1.5)
    parser.add_argument("--voxel-mm", type=float, default=0.4)
    parser.add_argument("--spacing-mm", type=float, default=0.5)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--name", default="job_memory")
    parser.add_argument("--before", type=Path, metavar="CHECKOUT", help="compare with the program of this checkout")
    parser.add_argument("--rounds", type=int, default=3, help="of a comparison")
    parser.add_argument("--alone", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        print(json.dumps(compute(options.cache, options.alone, options.limit_gb)))
        return 0
    make_inputs(options.cache, metres(options.voxel_mm), metres(options.spacing_mm))
    inputs = json.loads((options.cache / "inputs.json").read_bytes())
    run = alone if options.before is None else compared
    found = [run(name, options) for name in options.jobs]
    record = {
        "machine": machine(),
        "commit": commit(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "voxel_mm": options.voxel_mm,
        "scan_spacing_mm": options.spacing_mm,
        "voxels": inputs["voxels"],
        "scan_faces": inputs["scan_faces"],
        "limit_gb": options.limit_gb,
        "jobs": found,
    }
    stem = RESULTS / f"{options.name}-{datetime.now(UTC).date().isoformat()}"
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return int(any("failed" in job for job in found))


if __name__ == "__main__":
    sys.exit(main())
