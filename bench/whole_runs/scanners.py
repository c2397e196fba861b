"""One whole small run in which every scan profile imports its scanner's export and the CT suite sends its series.

The specimen is scanned by each scanner in turn; each scan is registered with the same images and evaluated.
`.venv/bin/python -m bench.whole_runs.scanners` writes bench/results/scanners-DATE; half an hour beside other work.
"""

from __future__ import annotations

import argparse
import datetime
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from bench.machine import RESULTS, commit, machine
from bench.whole_runs.whole_run import orthocapture, simulated_rig
from service.cli.demo import true_cameras, true_error_mm
from service.core.run.state import StepState
from service.dataset.summary import RunSummary, summarise
from service.run_start import recorded_run
from service.store.store import Store
from tests.support.ct.dicom_listener import dicom_listener
from tests.support.protocols.small_demo import SLICE_MM, small_demo

# Name of the device → the scanner of the rig, and the exports that together are one scan.
SCANNERS = {
    "artec_leo": ("artec_leo", 1),
    "artec_space_spider": ("artec_space_spider", 1),
    "shining3d": ("shining3d", 1),
    "structured_light_ply": ("structured_light/ply", 1),
    "structured_light_obj": ("structured_light/obj", 1),
    "structured_light_e57": ("structured_light/e57", 1),
    "zivid": ("zivid", 3),
    "photoneo": ("photoneo", 3),
}
SCENE = 7
WIDTH = 960
_POSES = "robot_corrected"


def main() -> int:
    """Run, and write the table; 1 if a step failed."""
    options = arguments()
    with tempfile.TemporaryDirectory(prefix="orthocapture-scanners-") as temporary:
        record = scanned_by_all(options.keep or Path(temporary), options.host)
    record |= {"date": options.date, "commit": commit(), "machine": machine()}
    stem = options.results / f"scanners-{options.date}"
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    text = as_markdown(record)
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return int(record["status"] != "completed")


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", default="127.0.0.171", help="address of the simulated arm")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder for the result files (bench/results)")
    parser.add_argument("--keep", type=Path, help="folder in which to keep the run; default: remove it")
    return parser.parse_args()


def scanned_by_all(folder: Path, host: str) -> dict[str, Any]:
    """The run, and what it says of each scanner."""
    protocol, rig, data = folder / "scanners.yaml", folder / "rig", folder / "data"
    folder.mkdir(parents=True, exist_ok=True)
    small_demo(protocol)
    record = with_scanners(yaml.safe_load(protocol.read_text(encoding="utf-8")))
    protocol.write_text(yaml.safe_dump(record, sort_keys=False, allow_unicode=True), encoding="utf-8")
    with dicom_listener(rig / "ct") as address:
        words = ["--image-width", str(WIDTH), "--ct-voxel-mm", str(SLICE_MM), "--speed-up", "10", "--host", host]
        words += ["--ct-sends-to", address, "--further-scanner", *(name for name, _ in SCANNERS.values())]
        with simulated_rig(rig, SCENE, words) as ready:
            doctor = orthocapture("doctor", "--rig", ready["rig"], "--json", timeout_s=300, log=folder / "doctor.log")
            run = orthocapture(
                "run", str(protocol), "--rig", ready["rig"], "--data", str(data), "--operator", "bench",
                "--auto-confirm", "--json", timeout_s=7200, log=folder / "run.log",
            )  # fmt: skip
    devices = json.loads(doctor.answer)["devices"]
    with Store.open(data, create=False) as store:
        run_id = store.find_run("latest")
        summary = summarise(store, run_id, recorded_run(store, run_id)[0])
        truth = json.loads(Path(ready["truth"]).read_text(encoding="utf-8"))
        rows = [_row(summary, name, devices[name], truth, rig / "truth_exposures.jsonl") for name in SCANNERS]
        series = summary.state.steps["ct_import"].measures
    return {
        "status": summary.state.status,
        "run": run.figures(),
        "ct": {"ok": devices["ct"]["ok"], "spheres_found": series.get("spheres_found")},
        "scanners": rows,
    }


def with_scanners(record: dict[str, Any]) -> dict[str, Any]:
    """The protocol with a scan, a registration and an evaluation for each scanner in place of the one."""
    steps: list[dict[str, Any]] = []
    by_id = {step["id"]: step for step in record["steps"]}
    for step in record["steps"]:
        if step["id"] == "control_scan":
            steps.append({**step, "params": {**step["params"], "device": "scanner"}})
        elif step["id"] == "scanning":
            for name, (_, parts) in SCANNERS.items():
                steps += _steps_of(by_id, name, parts)
        elif step["id"] not in ("registration", "evaluation"):
            steps.append(step)
    return {**record, "steps": steps}


def _steps_of(by_id: Mapping[str, dict[str, Any]], name: str, parts: int) -> list[dict[str, Any]]:
    scan, registration, evaluation = (by_id[step] for step in ("scanning", "registration", "evaluation"))
    scanning = {
        **scan,
        "id": f"scanning_{name}",
        "params": {**scan["params"], "device": name, "parts": parts},
        "simulated_hands": [{"action": "hand_scan", "device": name}],
    }
    registering = {
        **registration,
        "id": f"registration_{name}",
        "params": {**registration["params"], "scan": scanning["id"]},
    }
    judging = {
        **evaluation,
        "id": f"evaluation_{name}",
        "params": {**evaluation["params"], "registration": registering["id"], "scan": scanning["id"]},
    }
    return [scanning, registering, judging]


def _row(
    summary: RunSummary, name: str, found: Mapping[str, Any], truth: Mapping[str, Any], exposures: Path
) -> dict[str, Any]:
    """The figures of one scanner; without an evaluation where its steps failed."""
    scan, evaluation = (summary.state.steps[f"{kind}_{name}"].measures for kind in ("scanning", "evaluation"))
    return {
        "device": name,
        "doctor": found["ok"],
        "model": found["identity"]["model"],
        "exports": SCANNERS[name][1],
        "faces": scan.get("faces"),
        "spheres_found": scan.get("spheres_found"),
        "part_residual_max_mm": scan.get("part_residual_max_mm"),
        "sphere_change_max_mm": scan.get("sphere_change_max_mm"),
        "mean_radial_error_mm": evaluation.get(f"{_POSES}_mean_radial_error_mm"),
        "mean_reprojection_error_px": evaluation.get(f"{_POSES}_mean_reprojection_error_px"),
        "true_error_mm": _true_mm(summary, summary.state.steps[f"registration_{name}"], name, truth, exposures),
    }


def _true_mm(
    summary: RunSummary, registered: StepState, name: str, truth: Mapping[str, Any], exposures: Path
) -> float | None:
    scans = [scan for scan in truth["scans"] if scan["device"] == name]
    found = (registered.result or {}).get("registrations", {}).get(_POSES)
    if not scans or found is None:
        return None
    spheres_m = (summary.state.steps[f"scanning_{name}"].result or {})["spheres_m"]
    T_world_camera = true_cameras(summary, exposures)
    return true_error_mm(found["T_scan_camera"], T_world_camera, scans[-1]["T_world_scan"], spheres_m)


def as_markdown(record: Mapping[str, Any]) -> str:
    """Format the record as Markdown."""
    computer = record["machine"]
    columns = {
        "device": "profile",
        "doctor": "doctor",
        "exports": "exports",
        "faces": "faces",
        "spheres_found": "spheres",
        "part_residual_max_mm": "largest residual of a part (mm)",
        "sphere_change_max_mm": "largest change of a sphere (mm)",
        "mean_radial_error_mm": "mean radial error (mm)",
        "mean_reprojection_error_px": "mean reprojection error (px)",
        "true_error_mm": "true error (mm)",
    }
    rows = [[_cell(row[column]) for column in columns] for row in record["scanners"]]
    lines = [
        f"# Every scan profile in a whole small run, {record['date']}",
        "",
        f"Commit {record['commit']}; {computer['processor']}, {computer['cores']} cores, {computer['memory_gb']} GB, "
        f"{computer['system']}, Python {computer['python']}. Scene {SCENE}, six views and six control views "
        f"{WIDTH} px wide, arm UR10e, CT voxels of {SLICE_MM:g} mm.",
        "",
        f"The run: {record['status']}, {record['run']['seconds']:.0f} s beside other work. The simulated CT suite "
        "sent its series with dcmtk's `storescu` to `orthocapture dicom-listen` during the run: "
        f"{_cell(record['ct']['spheres_found'])} spheres found, doctor {_cell(record['ct']['ok'])}.",
        "",
        f"Each scan is registered with the same images ({_POSES}) and evaluated on the control spheres. Largest "
        "change of a sphere: against the hand scanner's scan. True error: at the scene's centre against the "
        "simulator's record.",
        "",
        "| " + " | ".join(columns.values()) + " |",
        "|---|---" + "|---:" * (len(columns) - 2) + "|",
        *("| " + " | ".join(row) + " |" for row in rows),
    ]
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, bool):
        return "ok" if value else "not ok"
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.3f}"


if __name__ == "__main__":
    raise SystemExit(main())
