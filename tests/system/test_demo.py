"""The demonstration as its user runs it: one command from specimen to registered data set."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import socket
import sqlite3
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import trimesh
import yaml

from service.audit.recorded_run import read_run
from service.audit.replay import CopiedResults
from service.cli.demo import free_address
from service.core.jobs import jobs_of, references_in
from tests.support.processes.package import Package, installed_package
from tests.support.processes.waiting import until
from tests.support.rig.rig import RIG_LOCK, orthocapture

pytestmark = [pytest.mark.slow, pytest.mark.whole(always=True), pytest.mark.timeout(900)]
MADE = "ORTHOCAPTURE_DEMO_RUN"  # the folder of the demonstration that `make demo` made


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Package:
    return installed_package(tmp_path_factory)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The result of the demonstration: the one that `make demo` made (as in .ci/run), or else one as installed."""
    made = os.environ.get(MADE)
    if made is not None:
        (result,) = Path(made).glob("*/result.json")
        return json.loads(result.read_text(encoding="utf-8"))
    folder = tmp_path_factory.mktemp("demo")
    with RIG_LOCK:
        answer = installed_package(tmp_path_factory).run("demo", "--json", cwd=folder, timeout_s=840)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    (result,) = folder.glob("demo-run/*/result.json")
    told = json.loads(answer.stdout.splitlines()[-1])
    assert json.loads(result.read_text(encoding="utf-8")) == told
    return told


@pytest.fixture(scope="module")
def events(demo: dict[str, Any]) -> list[dict[str, Any]]:
    """The events of the run, as the command shows them."""
    answer = orthocapture("audit", "show", demo["run"], "--data", demo["data_dir"], "--json")
    return json.loads(answer.stdout)["events"]


def test_table_has_the_papers_rows_and_its_reason(demo: dict[str, Any]) -> None:
    rows = {row["poses"]: row for row in demo["table"]}
    assert set(rows) == {"robot", "robot_corrected", "triangulated", "colmap", "glomap", "hybrid"}
    for source in ("robot_corrected", "triangulated", "colmap", "glomap", "hybrid"):
        assert rows[source]["mean_radial_error_mm"] <= 0.15
        assert rows[source]["true_error_mm"] <= 0.15
    # The arm's systematic error, which does not affect structure from motion.
    assert rows["robot"]["mean_radial_error_mm"] > 2 * rows["colmap"]["mean_radial_error_mm"]


def test_evidence_verifies_from_the_command_line(demo: dict[str, Any]) -> None:
    assert demo["audit_ok"] is True
    answer = orthocapture("audit", "verify", demo["run"], "--data", demo["data_dir"], "--json")
    assert answer.returncode == 0, answer.stdout
    assert json.loads(answer.stdout)["ok"] is True


def test_one_altered_byte_is_found(demo: dict[str, Any], tmp_path: Path) -> None:
    copy = tmp_path / "data"
    subprocess.run(["cp", "-r", demo["data_dir"], copy], check=True)
    photograph = max((copy / "artefacts").rglob("*"), key=lambda p: p.stat().st_size if p.is_file() else 0)
    photograph.chmod(0o644)
    with photograph.open("r+b") as file:
        file.seek(1000)
        byte = file.read(1)
        file.seek(1000)
        file.write(bytes([byte[0] ^ 1]))
    answer = orthocapture("audit", "verify", demo["run"], "--data", str(copy), "--json")
    assert answer.returncode == 1
    assert photograph.name in json.dumps(json.loads(answer.stdout)["first_fault"])


def test_views_come_from_both_stations_at_the_promised_size(
    demo: dict[str, Any], events: list[dict[str, Any]]
) -> None:
    captured = [e for e in events if e["kind"] == "viewpoint_captured"]
    views = [e for e in captured if any(a["kind"] == "image" for a in e["artefacts"])]
    assert len(views) >= 16
    folder = Path(demo["dataset"]) / "images"
    from PIL import Image  # noqa: PLC0415 - Pillow comes with scikit-image

    with Image.open(next(iter(sorted(folder.iterdir())))) as image:
        assert image.size[0] >= 1280
        assert image.size[1] >= 853


def test_data_set_is_in_one_frame(demo: dict[str, Any]) -> None:
    folder = Path(demo["dataset"])
    with (folder / "poses.csv").open() as file:
        poses = list(csv.DictReader(file))
    assert {row["image"] for row in poses} == {p.name for p in (folder / "images").iterdir()}
    mesh = trimesh.load(folder / "mesh.ply", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    centres = np.array([[float(row[k]) for k in "xyz"] for row in poses])
    distance_m = np.linalg.norm(centres - mesh.vertices.mean(axis=0), axis=1)
    assert np.all((distance_m > 0.4) & (distance_m < 1.0))
    assert json.loads((folder / "dataset.json").read_text())["simulated"] is True


def test_the_data_set_is_packaged_verified_and_recorded(demo: dict[str, Any], events: list[dict[str, Any]]) -> None:
    folder = Path(demo["dataset"])
    done = subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=False)
    assert done.returncode == 0
    assert demo["dataset_files"] == len((folder / "SHA256SUMS").read_text().splitlines())
    card = (folder / "DATACARD.md").read_text(encoding="utf-8")
    assert "SIMULATED" in card
    assert "No ethics statement was given" in card
    for name in ("croissant.json", "ro-crate-metadata.json", "views.csv"):
        assert (folder / name).is_file()
    exported = [event for event in events if event["kind"] == "evidence_exported"]
    assert len(exported) == 1
    # CT and scan agree where both show the specimen; the means hold what only one of them shows.
    floor_mm = demo["chamfer_floor_mm"]
    assert 0 < floor_mm < demo["ct_to_scan_median_mm"] < floor_mm + 0.5
    assert demo["chamfer_mm"] == pytest.approx((demo["ct_to_scan_mm"] + demo["scan_to_ct_mm"]) / 2, abs=1e-3)


def test_report_stands_alone(demo: dict[str, Any]) -> None:
    html = Path(demo["report"]).read_text()
    for text in ("Deviations", "colmap", "data:image/jpeg;base64", "plotly", "evidence verified", "simulated rig"):
        assert text in html
    assert 'src="http' not in html


def test_every_image_was_looked_at_while_the_specimen_was_there(
    demo: dict[str, Any], events: list[dict[str, Any]]
) -> None:
    answer = orthocapture("status", demo["run"], "--data", demo["data_dir"], "--json")
    steps = json.loads(answer.stdout)["steps"]
    looked_at: list[float] = []
    for name in ("viewpoint_capture_1", "control_capture_1", "viewpoint_capture_2", "control_capture_2"):
        assert {view["viewpoint"] for view in steps[name]["live"]} == set(steps[name]["captured"])
        assert all(view["spheres_seen"] >= 4 for view in steps[name]["live"])
        looked_at += [view["predicted_target_error_mm"] for view in steps[name]["live"]]
    last = steps["control_capture_2"]["measures"]
    assert 0 < last["predicted_target_error_mm"] <= max(looked_at)
    assert 0.6 <= last["specimen_coverage"] <= 1
    planned = _first_by_step(events, "step_note", "note=motion_plan")
    moved = _first_by_step(events, "viewpoint_captured", "station=")
    assert set(planned) == set(moved) > {"camera_calibration", "viewpoint_capture_1"}
    assert all(planned[step] < moved[step] for step in moved), "recorded before the first motion of each capture"


def _first_by_step(events: list[dict[str, Any]], kind: str, words: str) -> dict[str, int]:
    """The sequence number of each step's first event of a kind with these words in its summary."""
    first: dict[str, int] = {}
    for event in events:
        step = re.match(r"step=(\w+)", event["summary"])
        if event["kind"] == kind and step is not None and words in event["summary"]:
            first.setdefault(step[1], event["seq"])
    return first


def test_no_job_holds_a_copy_of_what_an_earlier_one_found(demo: dict[str, Any]) -> None:
    run = read_run(Path(demo["data_dir"]), demo["run"])
    jobs = sorted(jobs_of(run.state).values(), key=lambda job: job.enqueued_seq)
    assert any(next(references_in(job.arguments), None) is not None for job in jobs)
    earlier = CopiedResults()
    for job in jobs:
        assert earlier.as_references(job.arguments) == job.arguments, job.kind
        earlier.add(job)


def test_truth_never_enters_the_run(demo: dict[str, Any]) -> None:
    with contextlib.closing(sqlite3.connect(demo["database"])) as database:
        tables = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'event_words%'"  # an index
        names = [name for (name,) in database.execute(tables)]
        text = "\n".join(str(row) for name in names for row in database.execute(f'SELECT * FROM "{name}"'))
    assert "viewpoint_captured" in text
    # The ground truth of a run is its mesh of CT and scan; the truth of the rig must not be there.
    assert "truth" not in re.sub("ground[ _]truth", "", text, flags=re.IGNORECASE)


def test_sigterm_during_the_start_of_the_rig_leaves_nothing_behind(package: Package, tmp_path: Path) -> None:
    mark = f"of {tmp_path}"
    environment = {**package.environment(), "ORTHOCAPTURE_TEST": mark}

    def started() -> list[psutil.Process]:
        return [
            process for process in psutil.process_iter() if _environment(process).get("ORTHOCAPTURE_TEST") == mark
        ]

    with (
        RIG_LOCK,
        (tmp_path / "words").open("w") as words,
        subprocess.Popen(
            [package.bin / "orthocapture", "demo"], cwd=tmp_path, stdout=words, stderr=words, env=environment
        ) as demo,
    ):
        until(lambda: len(started()) > 1 or demo.poll() is not None, "the demo starts no rig", 300)
        demo.terminate()
    assert demo.returncode != 0
    until(lambda: not started(), "the demo left processes behind")


def _environment(process: psutil.Process) -> dict[str, str]:
    try:
        return process.environ()
    except psutil.Error:  # it has ended, or belongs to somebody else
        return {}


def test_a_taken_port_moves_the_demo_to_another_address(package: Package, tmp_path: Path) -> None:
    start = [package.bin / "orthocapture", "demo"]
    with RIG_LOCK, socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        first = free_address()
        taken.bind((first, 30004))
        taken.listen()
        with (
            (tmp_path / "words").open("w") as words,
            subprocess.Popen(start, cwd=tmp_path, stdout=words, stderr=words, env=package.environment()) as demo,
        ):
            try:
                deadline_s = time.monotonic() + 300
                while not (found := list(tmp_path.glob("demo-run/*/rig/rig.yaml"))):
                    assert demo.poll() is None, (tmp_path / "words").read_text()
                    assert time.monotonic() < deadline_s
                    time.sleep(0.2)
                devices = yaml.safe_load(found[0].read_text())["devices"].values()
            finally:
                processes = psutil.Process(demo.pid).children(recursive=True)
                demo.terminate()
        assert processes
        until(lambda: not any(process.is_running() for process in processes), "the demo left processes behind")
    (host,) = (device["host"] for device in devices if device["driver"] == "ur")
    assert host != first
    assert host.startswith("127.0.0.")
