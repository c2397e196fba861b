"""The paper's whole protocol on simulated rigs: errors, durations, bytes and memory."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import secrets
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, RESULTS, commit, machine
from bench.whole_runs.whole_run import whole_run
from simulators.scene.arm import ARM_ERRORS, ARM_ERRORS_USUAL
from simulators.sony_camera.recorded import names as bodies
from tests.support.protocols.shortened import shortened

PROTOCOL = REPOSITORY / "protocols" / "exvivo_spine.yaml"


def main(words: Sequence[str] | None = None) -> int:
    """Run the protocol on each scene; print and write the figures. Returns 1 if a scene did not complete."""
    options = arguments(words)
    scenes: list[int] = [*options.scenes, *(secrets.randbelow(10_000) for _ in range(options.drawn))]
    about = {
        "date": options.date,
        "commit": commit(),
        "machine": machine(),
        "protocol": options.protocol.name,
        "one_viewpoint_of": options.one_of,
        "image_width": options.image_width,
        "ct_voxel_mm": options.ct_voxel_mm,
        "speed_up": options.speed_up,
        "arm": options.arm,
        "arm_errors": options.arm_errors,
        "recorded": options.recorded,
    }
    stem = options.results / f"{options.name}-{options.image_width}-{options.date}"
    options.results.mkdir(parents=True, exist_ok=True)
    rig = ["--image-width", str(options.image_width), "--ct-voxel-mm", str(options.ct_voxel_mm),
           "--speed-up", str(options.speed_up), "--arm", options.arm, "--host", options.host,
           "--arm-errors", options.arm_errors, "--patience", str(options.patience),
           *(["--recorded", options.recorded] if options.recorded else [])]  # fmt: skip
    found: list[dict[str, Any]] = []
    text = ""
    for scene in scenes:
        with ExitStack() as stack:
            kept = options.keep and options.keep / f"scene-{scene}"
            folder = kept or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="orthocapture-whole-")))
            folder.mkdir(parents=True, exist_ok=True)
            protocol = options.protocol
            if options.one_of > 1:
                protocol = shortened(protocol, options.one_of, folder / protocol.name)
            load = round(os.getloadavg()[0], 1)
            print(f"scene {scene} …", file=sys.stderr, flush=True)
            answer = whole_run(
                protocol, scene, folder, rig, speed_up=options.speed_up, timeout_s=options.timeout_h * 3600,
                replayed=len(found) < options.replayed,
            )  # fmt: skip
        found.append({**answer, "load_before": load})
        # Written after each scene, so that an interrupted bench keeps its results.
        record = {**about, "scenes": found}
        stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        text = as_markdown(record)
        stem.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return int(any(scene.get("status") != "completed" for scene in found))


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="*", default=[1, 7, 21], metavar="SEED", help="seeds (1 7 21)")
    parser.add_argument("--drawn", type=int, default=2, metavar="N", help="number of further, random seeds (2)")
    parser.add_argument("--image-width", type=int, default=1920, help="width of the simulated photographs (1920)")
    parser.add_argument("--ct-voxel-mm", type=float, default=0.4, help="edge of the CT's voxels (0.4)")
    parser.add_argument("--speed-up", type=float, default=1.0, help="the arm takes 1/N of its time (1)")
    parser.add_argument(
        "--patience",
        type=float,
        default=0.0,
        metavar="S",
        help="as of `simulate rig`, on a machine that does more (0)",
    )
    parser.add_argument("--arm", default="UR10e", help="model of the simulated arm (UR10e)")
    parser.add_argument(
        "--arm-errors", choices=ARM_ERRORS, default=ARM_ERRORS_USUAL, help=f"of an UR10e ({ARM_ERRORS_USUAL})"
    )
    parser.add_argument(
        "--recorded", choices=bodies(), metavar="BODY", help="the camera states what this Sony was recorded to state"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address of its controller (127.0.0.1)")
    parser.add_argument("--protocol", type=Path, default=PROTOCOL, help="a protocol other than the paper's")
    parser.add_argument("--one-of", type=int, default=1, metavar="N", help="take one in N views (1)")
    parser.add_argument("--timeout-h", type=float, default=3.0, help="timeout of each command (3)")
    parser.add_argument("--replayed", type=int, default=1, metavar="N", help="replay the first N scenes (1)")
    parser.add_argument("--name", default="whole_protocol", help="name of the two result files")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the result files (bench/results)")
    parser.add_argument("--keep", type=Path, help="folder in which to keep the runs; default: remove them")
    return parser.parse_args(words)


def as_markdown(record: Mapping[str, Any]) -> str:
    """Format the record as Markdown."""
    computer = record["machine"]
    share = f", one view of {record['one_viewpoint_of']}" if record["one_viewpoint_of"] > 1 else ""
    lines = [
        f"# {record['protocol']} to its end{share}, {record['date']}",
        "",
        f"Commit {record['commit']}; {computer['processor']}, {computer['cores']} cores, {computer['memory_gb']} GB, "
        f"{computer['system']}, Python {computer['python']}; photographs {record['image_width']} px wide, "
        f"CT voxels of {record['ct_voxel_mm']} mm, {record['arm']} {record['speed_up']:g} times as fast as real, "
        f"with the errors `{record['arm_errors']}`{_body(record['recorded'])}.",
        "",
        "The true error is the registration's displacement at the scene's centre against the simulator's record. "
        "Nobody was asked anything: the simulated technician did what the screen told him.",
        "",
        *_table(record["scenes"]),
        "",
        *_course(record["scenes"]),
    ]
    return "\n".join(lines) + "\n"


def _body(recorded: str | None) -> str:
    return f"; the camera states what a real body was recorded to state (`{recorded}`)" if recorded else ""


def _table(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    headings = ("mean radial error (mm)", "mean reprojection error (px)", "true error (mm)")
    lines = [f"| scene | poses | {' | '.join(headings)} |", "|---:|---|---:|---:|---:|"]
    for scene in scenes:
        rows = scene.get("table", [])
        if not rows:
            lines.append(
                f"| {scene['scene']} | none: {scene.get('status', 'not begun')} at {scene.get('at')} | | | |"
            )
        for row in rows:
            true = row["true_error_mm"]
            shown = "" if true is None else f"{true:.3f}"
            figures = f"{row['mean_radial_error_mm']:.3f} | {row['mean_reprojection_error_px']:.2f} | {shown}"
            lines.append(f"| {scene['scene']} | {row['poses']} | {figures} |")
    return lines


def _course(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    lines: list[str] = []
    for scene in scenes:
        lines += [f"## Scene {scene['scene']}: {scene.get('status', 'not begun')}", ""]
        run = scene["run"]
        lines.append(f"Run: {run['seconds']:.0f} s, {run['peak_mb']} MB at most, load before {scene['load_before']}.")
        if "complaint" in run:
            lines.append(f"It ended with status {run['status']}: {run['complaint']}")
        if "figures" in scene:
            lines += _seconds(scene["figures"])
        if "bytes" in scene:
            held = scene["bytes"]
            lines.append(
                f"- {held['files']} files, {held['artefacts'] / 1e6:.0f} MB; database {held['database'] / 1e6:.1f} MB"
            )
        for name, figures in scene.get("commands", {}).items():
            lines.append(f"- {name}: {_words(figures)}")
        if scene.get("deviations"):
            lines.append(f"- deviations: {'; '.join(scene['deviations'])}")
        lines.append("")
    return lines


def _seconds(figures: Mapping[str, Any]) -> list[str]:
    beyond = figures["overhead_s"]
    lines = [f"- {figures['views']} exposures"]
    if beyond:
        lines.append(
            "- seconds a viewpoint beyond what arm, camera and the protocol's waits take: "
            f"median {beyond['median']}, mean {beyond['mean']}, worst {beyond['worst']} "
            f"({beyond['pairs']} pairs, {beyond['longer_pauses']} longer)"
        )
    for title, key in (("steps", "steps_s"), ("after the last scan", "after_the_scan_s")):
        parts = [f"{name} {seconds:g} s" for name, seconds in figures[key].items()]
        lines.append(f"- {title}: {', '.join(parts)}")
    jobs = [f"{kind} {job['jobs']} in {job['seconds']:g} s" for kind, job in figures["jobs_s"].items()]
    lines.append(f"- jobs: {', '.join(jobs)}")
    return lines


def _words(figures: Mapping[str, Any]) -> str:
    if "bytes" in figures:
        return f"{figures['bytes'] / 1e6:.1f} MB"
    failed = f", FAILED with status {figures['status']}: {figures['complaint']}" if "status" in figures else ""
    return f"{figures['seconds']:g} s, {figures['peak_mb']} MB{failed}"


if __name__ == "__main__":
    sys.exit(main())
