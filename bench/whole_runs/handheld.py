"""Accuracy of a hand-held capture compared with the robot's: handheld_spine.yaml and the demo on the same scenes."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, RESULTS, commit, machine
from bench.whole_runs.demo_accuracy import MEASURES, run_demo
from service.cli.demo import true_errors_mm
from service.core.protocol import load_protocol
from service.dataset.summary import summarise
from service.steps import params_models
from service.store.store import Store
from service.store.verification.verify import verify

PROTOCOL = REPOSITORY / "protocols" / "handheld_spine.yaml"
STEPS = ("board_capture", "handheld_capture")


def main(words: Sequence[str] | None = None) -> int:
    """Run every scene; print and write the tables. Returns 1 if a run failed."""
    options = arguments(words)
    about = {"date": options.date, "commit": commit(), "machine": machine(), "image_width": options.image_width}
    stem = options.results / f"handheld-{options.date}"
    scenes: list[dict[str, Any]] = []
    text = ""
    options.results.mkdir(parents=True, exist_ok=True)
    for seed in options.scenes:
        print(f"scene {seed} …", file=sys.stderr, flush=True)
        before = options.made
        by_hand = (
            run_by_hand(seed, options.image_width, options.hand)
            if before is None
            else summary(before / "data", before / "rig" / "truth.json")
        )
        scene: dict[str, Any] = {"scene": seed, "hand": by_hand}
        if not options.no_robot:
            scene["robot"] = run_demo(seed, options.image_width, None)
        scenes.append(scene)
        record = {**about, "hand": options.hand, "scenes": scenes}
        stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        text = as_markdown(record)
        stem.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return 1 if any("error" in run for scene in scenes for run in (scene["hand"], scene.get("robot", {}))) else 0


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[7], metavar="SEED", help="seeds (7)")
    parser.add_argument("--image-width", type=int, default=1280, help="width of the simulated photographs (1280)")
    parser.add_argument("--hand", default="usual", choices=("steady", "usual", "clumsy"), help="who holds the camera")
    parser.add_argument("--made", type=Path, help="folder with data/ and rig/ of an existing run of one scene")
    parser.add_argument("--no-robot", action="store_true", help="leave out the demo with the robot")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the result files (bench/results)")
    return parser.parse_args(words)


def run_by_hand(seed: int, image_width: int, hand: str) -> dict[str, Any]:
    """Run the protocol once in separate processes; returns images, table with true errors and audit, or the error."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-bench-") as temporary:
        folder = Path(temporary)
        with (folder / "rig.log").open("w") as log:
            rig = subprocess.Popen(
                [sys.executable, "-m", "simulators", "rig", "--scene", str(seed), "--dir", str(folder / "rig"),
                 "--image-width", str(image_width), "--ct-voxel-mm", "1.0", "--hand", hand,
                 "--parent", str(os.getpid())],
                cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True,
            )  # fmt: skip
        try:
            assert rig.stdout is not None
            ready = json.loads(rig.stdout.readline())
            answer = subprocess.run(
                [sys.executable, "-m", "service.cli.main", "run", str(PROTOCOL), "--rig", ready["rig"], "--data",
                 str(folder / "data"), "--operator", "bench", "--auto-confirm"],
                cwd=REPOSITORY, capture_output=True, text=True, check=False,
            )  # fmt: skip
        finally:
            rig.terminate()
            rig.wait(timeout=30)
        if answer.returncode != 0:
            lines = (answer.stderr + answer.stdout).strip().splitlines()
            return {"error": lines[-1] if lines else "no reason given"}
        return summary(folder / "data", Path(ready["truth"]))


def summary(data: Path, truth: Path) -> dict[str, Any]:
    """The figures of a completed run."""
    loaded = load_protocol(PROTOCOL, params_models())
    with Store.open(data) as store:
        run = summarise(store, store.find_run("latest"), loaded.protocol)
        true = true_errors_mm(run, truth)
        audit = verify(data, run.run_id)
    measures = {name: run.state.steps[name].measures for name in STEPS}
    return {
        "audit_ok": audit.ok,
        "images": {name: {k: m[k] for k in ("images_taken", "images_used")} for name, m in measures.items()},
        "predicted_target_error_mm": measures["handheld_capture"]["predicted_target_error_mm"],
        "table": {
            row.poses: {
                **{key: value for key, _ in MEASURES if (value := getattr(row, key, None)) is not None},
                "true_error_mm": true[row.poses],
            }
            for row in run.table()
        },
    }


def as_markdown(record: Mapping[str, Any]) -> str:
    """Format the record as Markdown."""
    computer = record["machine"]
    beside = any("robot" in scene for scene in record["scenes"])
    robot = " The robot's rows are those of the demo (22 images) on the same scene." if beside else ""
    lines = [
        f"# Accuracy of the capture by hand, {record['date']}",
        "",
        f"Commit {record['commit']}; {computer['processor']}, {computer['cores']} cores, {computer['memory_gb']} GB, "
        f"{computer['system']}, Python {computer['python']}; photographs {record['image_width']} px wide; simulated "
        f"hand: {record['hand']}.{robot}",
        "",
        "The true error is the registration's displacement at the scene's centre against the simulator's record.",
        "",
        f"| scene | camera | poses | {' | '.join(heading for _, heading in MEASURES)} | images used of taken |",
        "|---:|---|---|" + "---:|" * (len(MEASURES) + 1),
    ]
    for scene in record["scenes"]:
        for how in ("hand", "robot"):
            run = scene.get(how)
            if run is None:
                continue
            if "error" in run:
                lines.append(f"| {scene['scene']} | {how} | failed: {run['error']} |" + " |" * (len(MEASURES) + 1))
                continue
            taken = run.get("images", {}).get("handheld_capture")
            images = "" if taken is None else f"{taken['images_used']:.0f} of {taken['images_taken']:.0f}"
            for source, row in run["table"].items():
                figures = " | ".join(f"{row[key]:.3f}" for key, _ in MEASURES)
                lines.append(f"| {scene['scene']} | {how} | {source} | {figures} | {images} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
