"""Accuracy of the whole chain: the demo on several simulated scenes, with control-sphere errors and true errors."""

from __future__ import annotations

import argparse
import datetime
import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, RESULTS, commit, machine

MEASURES = (  # name in the demo's table, heading
    ("mean_radial_error_mm", "mean radial error (mm)"),
    ("mean_reprojection_error_px", "mean reprojection error (px)"),
    ("true_error_mm", "true error (mm)"),
)
DEMO_TIMEOUT_S = 1800


def main(words: Sequence[str] | None = None) -> int:
    """Run the demo on each scene; print and write the tables. Returns 1 if a demo failed."""
    options = arguments(words)
    about = {
        "date": options.date,
        "commit": commit(),
        "machine": machine(),
        "image_width": options.image_width,
    }
    options.results.mkdir(parents=True, exist_ok=True)
    stem = options.results / f"demo_accuracy-{options.date}"
    scenes: list[dict[str, Any]] = []
    text = ""
    for seed in options.scenes:
        scenes.append(run_demo(seed, options.image_width, options.keep))
        # Written after each scene, so that an interrupted bench keeps its results.
        record = {**about, "scenes": scenes, "summary": summarise(scenes)}
        stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        text = as_markdown(record)
        stem.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return 1 if any("error" in scene for scene in scenes) else 0


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[1, 2, 3], metavar="SEED", help="seeds (1 2 3)")
    parser.add_argument("--image-width", type=int, default=1280, help="width of the simulated photographs (1280)")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the result files (bench/results)")
    parser.add_argument("--keep", type=Path, help="folder in which to keep the runs; default: remove them")
    return parser.parse_args(words)


def run_demo(seed: int, image_width: int, keep: Path | None) -> dict[str, Any]:
    """Run one demo in separate processes; returns seed, duration, audit and table, or seed and error."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-bench-") as temporary:
        out = Path(temporary) if keep is None else keep / f"scene-{seed}"
        print(f"scene {seed} …", file=sys.stderr, flush=True)
        try:
            answer = subprocess.run(
                [sys.executable, "-m", "service.cli.main", "demo", "--scene", str(seed), "--image-width",
                 str(image_width), "--out", str(out), "--json"],
                cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=DEMO_TIMEOUT_S,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"scene": seed, "error": f"the demo took more than {DEMO_TIMEOUT_S} s"}
    lines = answer.stdout.splitlines()
    if answer.returncode != 0 or not lines:
        reason = (lines or answer.stderr.splitlines() or ["no reason given"])[-1]
        return {"scene": seed, "error": f"status {answer.returncode}: {reason}"}
    result = json.loads(lines[-1])
    return {
        "scene": seed,
        "duration_s": result["duration_s"],
        "audit_ok": result["audit_ok"],
        "table": {row["poses"]: {key: row[key] for key, _ in MEASURES} for row in result["table"]},
    }


def summarise(scenes: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Median and worst of each measure over the scenes that completed, by source of the poses."""
    tables = [scene["table"] for scene in scenes if "table" in scene]
    sources = dict.fromkeys(source for table in tables for source in table)
    summary: dict[str, dict[str, dict[str, float]]] = {}
    for source in sources:
        rows = [table[source] for table in tables if source in table]
        summary[source] = {
            key: {"median": statistics.median(row[key] for row in rows), "worst": max(row[key] for row in rows)}
            for key, _ in MEASURES
        }
    return summary


def as_markdown(record: Mapping[str, Any]) -> str:
    """Format the record as Markdown."""
    computer = record["machine"]
    lines = [
        f"# Accuracy of the demo, {record['date']}",
        "",
        f"Commit {record['commit']}; {computer['processor']}, {computer['cores']} cores, {computer['memory_gb']} GB, "
        f"{computer['system']}, Python {computer['python']}; photographs {record['image_width']} px wide.",
        "",
        "The true error is the registration's displacement at the scene's centre against the simulator's record.",
        "",
        f"| scene | poses | {' | '.join(heading for _, heading in MEASURES)} | duration (s) | audit |",
        "|---:|---|" + "---:|" * (len(MEASURES) + 1) + "---|",
    ]
    for scene in record["scenes"]:
        if "error" in scene:
            lines.append(f"| {scene['scene']} | failed: {scene['error']} |" + " |" * (len(MEASURES) + 2))
            continue
        audit = "verified" if scene["audit_ok"] else "FAILED"
        for source, row in scene["table"].items():
            figures = " | ".join(f"{row[key]:.3f}" for key, _ in MEASURES)
            lines.append(f"| {scene['scene']} | {source} | {figures} | {scene['duration_s']:.0f} | {audit} |")
    if record["summary"]:
        lines += ["", f"| poses | {' | '.join(f'{h}: median, worst' for _, h in MEASURES)} |"]
        lines.append("|---|" + "---:|" * len(MEASURES))
        for source, row in record["summary"].items():
            figures = " | ".join(f"{row[key]['median']:.3f}, {row[key]['worst']:.3f}" for key, _ in MEASURES)
            lines.append(f"| {source} | {figures} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
