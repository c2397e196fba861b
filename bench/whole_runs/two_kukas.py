"""A whole small run with two simulated KUKAs, with a hand-eye calibration of the first alone and with one of each.

`.venv/bin/python -m bench.whole_runs.two_kukas` prints the table as Markdown; seven minutes on a quiet machine.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import yaml

from bench.machine import commit, machine
from bench.whole_runs.whole_run import orthocapture, simulated_rig
from service.dataset.summary import RunSummary
from tests.support.protocols.two_arms import for_two_arms, kuka_demo
from tests.support.runs.ended_run import ended_run

SCENE, ARM = 7, "LBR Med 14"
POSES = ("robot", "robot_corrected", "triangulated", "hybrid")
OPTIONS = (
    "--image-width", "960", "--ct-voxel-mm", "1.0", "--speed-up", "10", "--arm", ARM, "--arms", "2",
    "--patience", "20",
)  # fmt: skip


def main() -> None:
    """Run both, and print what was found."""
    computer = machine()
    print(f"Commit {commit()}; {computer['processor']}, {computer['cores']} cores, Python {computer['python']}.\n")
    print("| hand-eye of | poses | mean radial error (mm) | mean reprojection error (px) | true error (mm) |")
    print("|---|---|---:|---:|---:|")
    with tempfile.TemporaryDirectory(prefix="orthocapture-two-kukas-") as folder:
        for name, each in (("the first arm", False), ("each arm", True)):
            print("\n".join(_rows(Path(folder) / name.replace(" ", "_"), name, each=each)), flush=True)


def _rows(folder: Path, name: str, *, each: bool) -> list[str]:
    folder.mkdir()
    protocol, data = folder / "demo.yaml", folder / "data"
    protocol.write_text(yaml.safe_dump(_protocol(protocol, each=each), sort_keys=False), encoding="utf-8")
    with simulated_rig(folder / "rig", SCENE, (*OPTIONS, "--host", "127.0.0.181")) as ready:
        done = orthocapture(
            "run", str(protocol), "--rig", ready["rig"], "--data", str(data), "--operator", "bench", "--auto-confirm",
            "--json", timeout_s=3600, log=folder / "run.log",
        )  # fmt: skip
    if done.status:
        raise SystemExit(f"{name}: the run did not end (status {done.status}): {done.answer}\n{done.complaint}")
    with ended_run(data, Path(ready["truth"])) as ended:
        rows = [
            f"| {name} | {row.poses} | {row.mean_radial_error_mm:.3f} | {row.mean_reprojection_error_px:.3f} | "
            f"{ended.true_mm[row.poses]:.3f} |"
            for row in ended.summary.table()
        ]
        return [*rows, *_calibrations(name, ended.summary)]


def _calibrations(name: str, summary: RunSummary) -> list[str]:
    found = {step: state.measures for step, state in summary.state.steps.items()}
    return [
        f"| {name} | {step}: held-out board images, {m['hand_eye_uncorrected_held_out_mm']:.3f} mm without "
        f"correction, {m['hand_eye_held_out_mm']:.3f} mm with it | | | |"
        for step, m in found.items()
        if "hand_eye_held_out_mm" in m
    ]


def _protocol(path: Path, *, each: bool) -> dict[str, Any]:
    record = kuka_demo(path)
    if each:
        record = for_two_arms(record, images=24)
    for step in record["steps"]:
        if step["kind"] == "registration":
            step["params"]["poses"] = list(POSES)
    return record


if __name__ == "__main__":
    main()
