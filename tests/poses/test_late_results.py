"""Results that come after the evaluation: every reader is told of them, and of those still missing."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import signal
import subprocess
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.audit import overview
from service.audit.background import PartialProgress
from service.audit.bundle import bundle_report, export_bundle
from service.audit.bundle_verifier import main as verify_bundle
from service.audit.overview import Digest, digests
from service.cli.operators import Display
from service.cli.run import wait_for_results
from service.core.gates import evaluate_gates
from service.core.protocol import Protocol, parse_protocol
from service.core.records.events import Payload
from service.core.records.run_events import (
    FilesKept,
    OperatorAction,
    RunCompleted,
    StepMeasured,
    StepNote,
    StepPassed,
    StepStarted,
)
from service.core.run.fold import fold
from service.core.run.state import LATER
from service.dataset.registrations import late_results, shared_adjustment_note
from service.followed_run import RunRecord, read_log
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.steps.due_jobs import missing_results
from service.steps.registration import PLANNED
from service.store.records import NewArtefact, NewJob
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.web import web_site
from tests.support.processes.forked import Forked
from tests.support.processes.waiting import until
from tests.support.record.outsider import rows
from tests.support.record.store import enqueue
from tests.support.recorded.registration_record import SPHERES, registration_record
from tests.support.recorded.reported_run import evaluation
from tests.support.rig.rig import REPOSITORY, command, orthocapture

PROTOCOL = """\
id: later
version: "1"
title: Results that come later
spheres: {radius_mm: 15, registration: 10}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: registration
    kind: registration
    title: Register
    confirm: false
    params:
      {images_of: [registration], calibration: registration, scan: registration, poses: [robot, triangulated, colmap]}
  - id: evaluation
    kind: evaluation
    title: Evaluate
    confirm: false
    params: {registration: registration, images_of: [registration], scan: registration}
    gates: [{measure: best_mean_radial_error_mm, max: 0.35, unit: mm}]
    sign: true
"""
IMAGES = [{"viewpoint": "v0", "sha256": "0" * 64, "station": "station_1", "T_base_flange": [[1.0, 0, 0, 0]] * 4}]
CAMERA = {"width": 1920, "height": 1280, "fx": 2000.0, "fy": 2000.0, "cx": 960.0, "cy": 640.0}
_WIDTH, _HEIGHT = 960, 640  # of images of noise


def table(**errors_mm: float) -> dict[str, Any]:
    rows = [
        dict(evaluation(value)["table"][0]) | {"poses": name, "source": name} for name, value in errors_mm.items()
    ]
    return {"table": rows, "budgets": {}}


@dataclass
class Run:
    """A run that has ended, decided by robot poses; two other sources were planned."""

    store: Store
    run_id: str
    protocol: Protocol

    def add(self, *payloads: Payload, actor: str = "runner") -> str:
        return self.store.record(self.run_id, payloads, actor=actor)[-1].sha256

    def job(self, kind: str, step: str, name: str, priority: int, **arguments: Any) -> None:
        key = f"{step}/0/{kind}/{name}/0"
        enqueue(self.store, self.run_id, NewJob(kind, step, 1, key, arguments, priority=priority), actor="runner")

    def finish(self, kind: str, result: Mapping[str, Any], late_s: float | None = None) -> None:
        job = self.store.claim_job("worker", 60.0, kinds=[kind])
        assert job is not None
        self.store.finish_job(job, measures={}, duration_s=1.0, result=result, late_s=late_s)

    def measure(self, step: str, measures: dict[str, float], result: dict[str, Any]) -> str:
        measured = StepMeasured(step=step, attempt=1, measures=measures, result=result)
        return self.add(measured, evaluate_gates(self.protocol.step(step), 1, measures))

    def log(self) -> RunRecord:
        return read_log(self.store, self.run_id, self.protocol)

    def digest(self) -> Digest:
        computed = digests(self.store)
        digest = computed.get(self.run_id, wait_s=60.0)
        computed.close()
        assert not isinstance(digest, PartialProgress)
        return digest


def record(folder: Path, store: Store) -> Run:
    (folder / "rig.yaml").write_text("name: small\nsimulated: true\ndevices: {}\n")
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="later.yaml")
    run_id = start_run(store, loaded, load_rig(folder / "rig.yaml"), operator="Ada", auto_confirm=False)
    run = Run(store, run_id, loaded.protocol)
    planned = StepNote(step="registration", attempt=1, note=PLANNED, data={"later": ["triangulated", "colmap"]})
    run.add(StepStarted(step="registration", attempt=1), planned)
    run.job("detect_spheres", "registration", "root", 1, images=IMAGES, camera=CAMERA, **SPHERES)
    run.measure("registration", {}, {"registrations": {"robot": registration_record("robot")}})
    run.add(StepPassed(step="registration", attempt=1), StepStarted(step="evaluation", attempt=1))
    judged = run.measure("evaluation", {"best_mean_radial_error_mm": 0.02}, table(robot=0.02))
    signed = OperatorAction(action="sign", step="evaluation", meaning="reviewed", signed_sha256=judged)
    run.add(signed, actor="Ada")
    run.add(StepPassed(step="evaluation", attempt=1), RunCompleted(deviations=0))
    checkpoint(store, run_id)
    return run


def arrive(run: Run) -> None:
    """One source before the end and one after it, both from the same features."""
    for name, error_mm, late_s in (("triangulated", 0.03, None), ("colmap", 0.0125, 720.0)):
        run.job("evaluate", "evaluation", f"{name}-x", LATER)
        run.finish("evaluate", table(**{name: error_mm}), late_s)
    run.job("structure_from_motion", "registration", "incremental", LATER, features={})


@pytest.fixture
def run(tmp_path: Path) -> Any:
    with Store.open(tmp_path / "data") as store:
        yield record(tmp_path, store)


def test_what_came_later_is_told_and_takes_nobodys_place(run: Run) -> None:
    assert run.digest().late == []
    arrive(run)
    digest = run.digest()
    assert digest.problem == ""
    assert digest.late == late_results(run.protocol, fold(run.protocol, run.store.events(run.run_id)))
    first, second = digest.late
    assert first.text.startswith("triangulated: arrived after the evaluation. It adds a row")
    assert "0.030 mm: not better than the run's own, robot with 0.020 mm" in first.text
    assert second.text.startswith("colmap: arrived 12 min after the end of the run.")
    assert "0.013 mm: better than the run's own" in second.text or "0.012 mm: better than" in second.text
    assert overview.counts(digest)["late_results"] == 2
    assert [f.seq for f in overview.findings(digest, "late_results")] == [first.seq, second.seq]
    assert "late_results" in overview.NOTE_GROUPS
    assert overview.findings(digest) == []  # not a deviation


def test_the_first_page_shows_what_came_and_what_is_still_to_come(run: Run, tmp_path: Path) -> None:
    arrive(run)
    with web_site(tmp_path) as web:
        browser = web.browser("auditor")

        def page() -> str:
            return browser.get(f"/audit/runs/{run.run_id}").text

        until(lambda: "colmap: arrived 12 min after the end of the run" in page(), "nothing is said of what came")
        assert "COLMAP from scratch: waits for a worker, then about" in page()
        job = run.store.claim_job("worker", 60.0)
        assert job is not None
        assert "COLMAP from scratch: still computing, about" in page()


def test_an_aborted_run_waits_for_nothing(run: Run) -> None:
    state, started = run.log().state, dict[str, str]()
    now = "2030-01-01T00:00:00Z"
    assert {one.name for one in missing_results(run.protocol, state, started, now, 2)} >= {"triangulated", "colmap"}
    assert missing_results(run.protocol, replace(state, status="aborted"), started, now, 2) == []


def test_the_report_the_data_set_and_the_bundle_tell_the_same(run: Run, tmp_path: Path) -> None:
    arrive(run)
    out = tmp_path / "out"
    out.mkdir()
    made = export_bundle(
        run.store,
        run.run_id,
        out / "b.zip",
        actor="Ada",
        report=bundle_report(tmp_path / "data", run.run_id, with_pictures=False),
    )
    assert verify_bundle([str(made.path)]) == 0
    with zipfile.ZipFile(made.path) as bundle:
        readme, report = bundle.read("README.txt").decode(), bundle.read("report.html").decode()
        crate = json.loads(bundle.read("ro-crate-metadata.json"))
    assert "NOT IN YET" in readme
    assert "  - COLMAP from scratch: was still being computed\n" in readme
    dataset = next(item for item in crate["@graph"] if item["@id"] == "./")
    assert "Not in when this was made: " in dataset["description"]
    for told in (
        "Results that arrived later",
        "colmap: arrived 12 min after the end of the run",
        "What was judged and signed is robot",
        "COLMAP from scratch: was still being computed",
        "triangulated and colmap come from the same features and matches",
    ):
        assert told in report


def test_sources_with_one_final_adjustment_are_no_confirmations_of_each_other(run: Run) -> None:
    state = run.log().state
    assert shared_adjustment_note(run.protocol, state) == ""  # one row
    arrive(run)
    note = shared_adjustment_note(run.protocol, run.log().state)
    assert note.startswith("triangulated and colmap come from the same features and matches")
    assert "They are one measurement" in note
    assert "hybrid" not in note


def test_ctrl_c_while_waiting_ends_in_order_and_says_what_goes_on(run: Run) -> None:
    arrive(run)
    said: list[str] = []

    class Heard(Display):
        def __init__(self) -> None:
            pass

        def tell(self, message: str) -> None:
            said.append(message)

        def show(self, what: str, done: int, total: int) -> None:
            signal.raise_signal(signal.SIGINT)

        def clear(self) -> None:
            said.append("cleared")

    wait_for_results(run.store, run.run_id, run.protocol, Heard())
    assert said[-2] == "cleared"
    assert "--until-idle" in said[-1]
    assert run.store.open_jobs(run.run_id) == 2


def long_job(run: Run, count: int) -> None:
    """Compute features of noise images, which takes long and which nobody waits for."""
    draw = np.random.default_rng(1)
    images: list[dict[str, str]] = []
    for number in range(count):
        jpeg = cv2.imencode(".jpg", draw.integers(0, 255, (_HEIGHT, _WIDTH, 3), np.uint8))[1].tobytes()
        ref = run.store.put_bytes(jpeg, kind="image", media_type="image/jpeg", original_name=f"{number}.jpg")
        kept = FilesKept(step="registration", attempt=1, device="camera", note="noise", artefacts=(ref,))
        row = NewArtefact(ref, "camera", "registration", 1)
        run.store.record(run.run_id, [kept], actor="runner", artefacts=[row])
        images.append({"viewpoint": f"n{number}", "sha256": ref.sha256})
    camera = {"width": _WIDTH, "height": _HEIGHT, **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)} | {
        "fx": 2000.0,
        "fy": 2000.0,
        "cx": 480.0,
        "cy": 320.0,
    }
    effort = {"max_image_size": 3200, "max_features": 8000, "neighbours": 12}
    run.job("features", "registration", "noise", LATER, images=images, camera=camera, effort=effort)


def jobs(data: Path, run_id: str) -> dict[str, str]:
    found = rows(data, f"SELECT kind, state FROM jobs WHERE run_id = '{run_id}'")
    return {str(kind): str(state) for kind, state in found}


@pytest.mark.slow
@pytest.mark.timeout(400)  # five processes, one after another
def test_a_terminal_that_waits_can_be_left_and_nothing_is_lost(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data) as store:
        run = record(tmp_path, store)
        long_job(run, 80)
        run_id = run.run_id
    master, slave = pty.openpty()
    words = command("resume", run_id, "--data", str(data))
    waiting = Forked(words, cwd=REPOSITORY, stdin=slave, stdout=slave, stderr=slave, start_new_session=True)
    os.close(slave)
    said = ""

    def shown() -> str:
        nonlocal said
        with contextlib.suppress(OSError):  # the terminal closes with the program
            while select.select([master], [], [], 0)[0]:
                said += os.read(master, 65536).decode(errors="replace")
        return said

    try:
        _left_while_it_waits(waiting, data, run_id, shown, tmp_path / "bundle-SIMULATED.zip")
    finally:
        waiting.kill()
        waiting.wait()
        os.close(master)


def _left_while_it_waits(
    waiting: subprocess.Popen[bytes], data: Path, run_id: str, shown: Callable[[], str], bundle: Path
) -> None:
    until(lambda: "Ctrl-C leaves them" in shown(), shown, 120.0)
    until(lambda: jobs(data, run_id)["features"] == "running", shown, 120.0)
    exported = orthocapture("audit", "export", run_id, str(bundle), "--data", str(data))
    assert exported.returncode == 0, exported.stderr
    assert verify_bundle([str(bundle)]) == 0
    assert jobs(data, run_id)["features"] == "running"  # all this during the computation
    os.killpg(waiting.pid, signal.SIGINT)  # what Ctrl-C does
    until(lambda: bool(shown()) and waiting.poll() is not None, shown, 60.0)
    assert waiting.returncode == 0, shown()
    assert "worker --data" in shown()
    assert "is completed" in shown()
    assert "Traceback" not in shown()
    assert jobs(data, run_id)["features"] == "queued"
    assert verify(data, run_id).ok


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_what_was_left_is_computed_by_the_next_worker(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store:
        run = record(tmp_path, store)
        long_job(run, 1)
        abandoned = store.claim_job("worker", 0.0, kinds=["features"])  # its worker was killed
        assert abandoned is not None
    done = orthocapture("worker", "--data", str(tmp_path / "data"), "--until-idle")
    assert done.returncode == 0, done.stderr
    assert jobs(tmp_path / "data", run.run_id)["features"] == "finished"
    assert verify(tmp_path / "data", run.run_id).ok
