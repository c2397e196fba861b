"""A whole run that measures its outlines in raw files: developed by the worker, recorded, verified and replayed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

from service.core.records.run_events import JobEnqueued, JobFinished
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.rig.rig import REPOSITORY, orthocapture
from tests.support.runs.import_folder import Photographer, around, over_the_board

PROTOCOL = REPOSITORY / "protocols" / "import_spine.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs with raw files beside them, except for the board's; scans, but no CT."""
    folder = tmp_path_factory.mktemp("raw") / "spine"
    photographer = Photographer(folder, 640)
    photographer.photographs("calibration", over_the_board(9), board=True)
    photographer.raw = True
    photographer.photographs("control", around(2, turn=0.1))
    photographer.control_spheres = False
    photographer.photographs("images", around(8))
    photographer.scan("control_scan", control_spheres=True, nth=1)
    photographer.scan("scan", control_spheres=False, nth=2)
    return folder


@pytest.fixture(scope="module")
def protocol(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Up to the registration: what follows is the same wherever the outlines were measured."""
    protocol = yaml.safe_load(PROTOCOL.read_text())
    steps = {step["id"]: step for step in protocol["steps"]}
    steps["registration"]["params"] |= {"poses": ["colmap"], "measure_on": "raw"}
    steps["registration"]["params"]["structure_from_motion"] = {"max_image_size": 640, "max_features": 3000}
    for name, measure in (("calibration_images", "images_imported"), ("camera_calibration", "views")):
        next(g for g in steps[name]["gates"] if g["measure"] == measure)["min"] = 6
    protocol["steps"] = protocol["steps"][: protocol["steps"].index(steps["registration"]) + 1]
    path = tmp_path_factory.mktemp("protocol") / "raw.yaml"
    path.write_text(yaml.safe_dump(protocol, sort_keys=False))
    return path


@pytest.mark.slow
@pytest.mark.whole
@pytest.mark.timeout(1200)
def test_a_run_develops_its_raw_files_and_measures_in_them(folder: Path, protocol: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    words = ["import", str(folder), "--protocol", str(protocol), "--simulated", "--operator", "Ada", "--json"]
    words += ["--specimen", "S1"]
    answer = orthocapture(*words, "--data", str(data), timeout_s=900)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    result = json.loads(answer.stdout.splitlines()[-1])
    assert result["status"] == "completed"
    with Store.open(data) as store:
        payloads = [event.payload for event in store.events(result["run"])]
    enqueued = {p.job: p for p in payloads if isinstance(p, JobEnqueued)}
    finished = [(enqueued[p.job], p) for p in payloads if isinstance(p, JobFinished)]
    developed = {
        job.arguments["viewpoint"]: done.artefacts[0].sha256 for job, done in finished if job.job_kind == "develop"
    }
    assert len(developed) == 10
    searched = [(job, done) for job, done in finished if job.job_kind == "detect_spheres"]
    assert [job.arguments["developed"] for job, _ in searched] == [developed]
    assert searched[0][1].measures["outlines_not_in_raw"] <= 3
    assert verify(data, result["run"]).ok
    kinds = "develop,detect_spheres,register"  # whole runs are replayed elsewhere
    words = ["replay", result["run"], "--jobs", kinds, "--data", str(data), "--json"]
    replayed = orthocapture(*words, timeout_s=300)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.timeout(600)
def test_a_run_without_raw_files_says_which_are_missing(folder: Path, protocol: Path, tmp_path: Path) -> None:
    alone = Path(shutil.copytree(folder, tmp_path / "alone"))
    for raw in (alone / "images").glob("*.ARW"):
        raw.unlink()
    words = ["import", str(alone), "--protocol", str(protocol), "--simulated", "--operator", "Ada", "--json"]
    words += ["--specimen", "S1"]
    answer = orthocapture(*words, "--data", str(tmp_path / "data"), timeout_s=300)
    assert answer.returncode != 0
    assert "8 images of 10 without a raw file" in answer.stdout
