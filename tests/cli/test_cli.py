"""The command line: its output, refusals and exit status."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import pytest
from typer.testing import CliRunner, Result

from service.cli.common import console
from service.cli.main import app
from service.core.records.run_events import ActionRefused, OperatorAction
from service.store.store import Store
from tests.support.runs.bench_run import PROTOCOL, record_runs

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).with_name("orthocapture")
COMMANDS = (
    "demo", "serve", "run", "resume", "import", "act", "draw-region", "cancel", "note", "status", "runs",
    "compare", "history", "worker", "doctor", "dicom-listen", "calibrate", "import-ros", "develop", "sfm",
    "register", "spheres", "layout", "fuse", "evaluate", "benchmark", "simulate", "audit", "store", "replay",
    "export", "accounts", "protocol", "plan",
)  # fmt: skip


def invoke(*arguments: object) -> Result:
    """Run the command; any exception other than an exit is a defect."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert "Traceback" not in result.output
    return result


def answer_of(result: Result) -> Any:
    """The single line that --json printed."""
    (line,) = result.stdout.splitlines()
    return json.loads(line)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A data folder with a completed run and a later one that has just begun."""
    folder = tmp_path_factory.mktemp("recorded")
    return folder / "data", *record_runs(folder)


# --- help and usage ---------------------------------------------------------------------------------------


def test_the_installed_command_names_every_command() -> None:
    done = subprocess.run([COMMAND, "--help"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    listed = re.findall(r"^│ (\S*) +(?=[A-Z])", done.stdout[done.stdout.index("─ Capture ─") :], re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS), "each in one group, none without its name"


def test_the_installed_command_tells_its_version() -> None:
    done = subprocess.run([COMMAND, "--version"], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == f"orthocapture {version('orthocapture')}\n"


@pytest.mark.parametrize("command", [c for c in COMMANDS if c != "simulate"])
def test_every_command_explains_itself(command: str) -> None:
    result = invoke(command, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ["fly"],
        ["status", "--colour"],
        ["run"],
        ["run", "protocols/demo.yaml"],
        ["doctor"],
        ["act", "dance"],
        ["demo", "--scene", "seven"],
        ["protocol", "check"],
    ],
)
def test_wrong_usage_has_status_2(arguments: list[str]) -> None:
    assert invoke(*arguments).exit_code == 2


# --- protocols --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["demo", "exvivo_spine"])
def test_our_protocols_are_sound(name: str) -> None:
    file = ROOT / "protocols" / f"{name}.yaml"
    result = invoke("protocol", "check", file)
    assert result.exit_code == 0
    assert "is valid" in result.output
    record = answer_of(invoke("protocol", "check", file, "--json"))
    assert record["id"] == name
    irreversible = [step["id"] for step in record["steps"] if step["irreversible"]]
    assert {"control_sphere_removal", "spraying"} <= set(irreversible)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("kind: checklist", "kind: checklst", 11, "did you mean 'checklist'"),
        ("exposure_s: 1/50", "exposure_s: fast", 6, "neither a number"),
        ("purpose: dataset", "purpose: art", 20, "dataset"),
        ("requires: [capture]", "requires: [scan]", 35, "no step 'scan'"),
        ("sign: true", "sign: false", 33, "sign: true"),
        ("product: Blue,", "", 36, "missing field"),
        ("steps:", "steps: [", 10, "YAML"),
    ],
)
def test_a_broken_protocol_is_refused_by_line(tmp_path: Path, old: str, new: str, line: int, words: str) -> None:
    file = tmp_path / "broken.yaml"
    file.write_text(PROTOCOL.replace(old, new, 1))
    result = invoke("protocol", "check", file)
    assert result.exit_code == 1
    assert f"{file}:{line}" in result.output
    assert words in result.output
    assert answer_of(invoke("protocol", "check", file, "--json"))["error"]["kind"] == "ProtocolError"


def test_a_missing_protocol_is_refused(tmp_path: Path) -> None:
    assert invoke("protocol", "check", tmp_path / "none.yaml").exit_code == 1


# --- runs -------------------------------------------------------------------------------------------------


def test_status_shows_steps_gates_and_views(recorded: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    data, completed, begun = recorded
    monkeypatch.setattr(console, "width", 220)  # a narrower table breaks its lines
    result = invoke("status", completed, "--data", data)
    assert result.exit_code == 0
    assert "Viewpoints captured 4, allowed ≥ 3: ok" in result.output
    record = answer_of(invoke("status", completed, "--data", data, "--json"))
    assert (record["run"], record["status"]) == (completed, "completed")
    assert record["steps"]["capture"]["captured"] == ["v001", "v002", "v003", "v004"]
    assert answer_of(invoke("status", "--data", data, "--json"))["run"] == begun


def test_an_unknown_run_or_folder_is_refused_and_nothing_is_made(
    recorded: tuple[Path, str, str], tmp_path: Path
) -> None:
    assert "no run is called" in invoke("status", "nobody", "--data", recorded[0]).output
    for command in (["status"], ["act", "pause"], ["resume"], ["audit", "show"], ["audit", "verify"]):
        result = invoke(*command, "--data", tmp_path / "nothing")
        assert result.exit_code == 1, command
        assert "Error:" in result.output
    assert not (tmp_path / "nothing").exists()


def test_act_records_what_is_allowed_and_what_was_refused(tmp_path: Path) -> None:
    _, run = record_runs(tmp_path)
    data = tmp_path / "data"
    refused = invoke("act", "skip", "--run", run, "--data", data, "--operator", "Grace")
    assert refused.exit_code == 1
    assert "needs a reason" in refused.output
    assert invoke("act", "redo", "--run", run, "--data", data, "--json", "--reason", "why not").exit_code == 1
    accepted = invoke("act", "confirm", "--run", run, "--data", data, "--operator", "Grace", "--json")
    assert answer_of(accepted) == {"run": run, "recorded": "confirm", "step": "fixation"}
    unsaid = invoke("act", "abort", "--data", data, "--operator", "Grace")
    assert (unsaid.exit_code, "needs a reason" in unsaid.output) == (1, True)
    assert invoke("act", "abort", "--data", data, "--reason", "done for today").exit_code == 0
    with Store.open(data) as store:
        events = store.events(run)
    refusals = [event for event in events if isinstance(event.payload, ActionRefused)]
    assert refusals[0].actor == "Grace"
    assert "needs a reason" in refusals[0].payload.model_dump()["why"]
    confirm = next(event.payload for event in events if isinstance(event.payload, OperatorAction))
    assert confirm.checklist == ("wires hold", "board lies")
    assert answer_of(invoke("status", "--data", data, "--json"))["status"] == "aborted"
    assert invoke("act", "pause", "--data", data).exit_code == 1


def test_resume_of_a_completed_run_has_nothing_to_do(recorded: tuple[Path, str, str]) -> None:
    data, completed, _ = recorded
    result = invoke("resume", completed, "--data", data, "--no-worker", "--json")
    assert result.exit_code == 0
    assert answer_of(result)["status"] == "completed"


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        ("name: real\ndevices: {}\n", "simulated rigs only"),
        ("name: liar\nsimulated: true\ndevices:\n  robot: {driver: ur, host: 192.168.1.20}\n", "192.168.1.20"),
        ("name: liar\nsimulated: true\ndevices:\n  robot: {driver: ur, host: localhost.example.org}\n", "localhost."),
        ("name: liar\nsimulated: true\ndevices:\n  camera: {driver: gphoto, port: 'usb:'}\n", "usb:"),
    ],
)
def test_auto_confirm_is_for_simulated_rigs_only(tmp_path: Path, rig: str, words: str) -> None:
    (tmp_path / "rig.yaml").write_text(rig)
    protocol = ROOT / "protocols" / "demo.yaml"
    data = tmp_path / "data"
    result = invoke("run", protocol, "--rig", tmp_path / "rig.yaml", "--data", data, "--auto-confirm")
    assert result.exit_code == 1
    assert words in result.output
    with Store.open(data) as store:
        assert store.runs() == []


def test_a_wrong_rig_file_is_refused_by_field(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: x\ndevices: {}\nstations: {station_1: {robot: arm, scene_centre_m: [0, 0]}}\n")
    result = invoke("doctor", "--rig", rig)
    assert result.exit_code == 1
    assert "stations.station_1.approach_azimuth_deg" in result.output
    assert str(rig) in result.output


@pytest.mark.slow
def test_a_run_that_is_told_to_end_takes_its_worker_with_it(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("name: bench\ndevices: {}\n")
    (tmp_path / "bench.yaml").write_text(PROTOCOL)
    words = [COMMAND, "run", "bench.yaml", "--rig", "rig.yaml", "--data", "data", "--specimen", "S1"]
    with subprocess.Popen(
        words, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stderr is not None
        while "Type one of" not in (line := run.stderr.readline()):
            assert line, "it ended by itself"
        workers = psutil.Process(run.pid).children(recursive=True)
        assert workers
        run.terminate()
        assert run.wait(timeout=60) != 0
    assert psutil.wait_procs(workers, timeout=60)[1] == []
    assert answer_of(invoke("status", "--data", tmp_path / "data", "--json"))["status"] == "active"


def test_a_worker_without_work_ends_when_told(recorded: tuple[Path, str, str]) -> None:
    handler = signal.getsignal(signal.SIGTERM)
    try:
        assert answer_of(invoke("worker", "--data", recorded[0], "--until-idle", "--json")) == {"jobs": 0}
    finally:
        signal.signal(signal.SIGTERM, handler)


# --- audit ------------------------------------------------------------------------------------------------


def test_audit_shows_and_verifies(recorded: tuple[Path, str, str]) -> None:
    data, completed, _ = recorded
    shown = invoke("audit", "show", completed, "--data", data)
    assert shown.exit_code == 0
    assert "viewpoint captured" in shown.output.replace("\n", " ")
    events = answer_of(invoke("audit", "show", completed, "--data", data, "--json"))["events"]
    assert events[0]["kind"] == "run_started"
    verified = invoke("audit", "verify", completed, "--data", data)
    assert verified.exit_code == 0
    assert "Verified" in verified.output
    assert answer_of(invoke("audit", "verify", "all", "--data", data, "--json"))["ok"] is True


def test_audit_names_the_file_that_was_changed(tmp_path: Path) -> None:
    completed, _ = record_runs(tmp_path)
    data = tmp_path / "data"
    with Store.open(data) as store:
        row = next(row for row in store.artefacts(completed) if row.ref.kind == "image")
        path = store.artefact_path(row.ref.sha256)
    path.chmod(0o600)
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    result = invoke("audit", "verify", completed, "--data", data)
    assert result.exit_code == 1
    assert "NOT verified" in result.output
    report = answer_of(invoke("audit", "verify", completed, "--data", data, "--json"))
    assert report["ok"] is False
    assert row.ref.sha256 in json.dumps(report["first_fault"])


# --- devices ----------------------------------------------------------------------------------------------


def test_doctor_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "name: bare\ndevices:\n"
        "  robot: {driver: ur, host: 127.0.0.9}\n"
        "  scanner: {driver: scan_folder, folder: scans}\n"
        "  ct: {driver: dicom_folder, folder: ct}\n"
        "  lightbox: {driver: lightbox, port: nowhere}\n"
        "  other: {driver: fanuc}\n"
        "  typo: {driver: ur, hots: 127.0.0.1}\n"
    )
    result = invoke("doctor", "--rig", rig, "--data", tmp_path / "data")
    assert result.exit_code == 1
    for words in ("✗ robot", "✓ scanner", "✗ ct there is no such folder", "✗ lightbox", "no driver 'fanuc'", "hots"):
        assert words in result.output
    assert "GB free" in result.output
    rig.write_text("name: bare\ndevices:\n  ct: {driver: dicom_folder, folder: ct}\n")
    report = answer_of(invoke("doctor", "--rig", rig, "--data", tmp_path / "data", "--json"))
    assert report["ok"] is False
    assert report["devices"]["ct"]["error"]["kind"] == "DeviceUnavailableError"
    assert report["devices"]["ct"]["error"]["remedy"]
    assert report["data"]["free_bytes"] > 0


@pytest.mark.slow
def test_doctor_says_that_the_library_of_an_arm_is_not_installed(tmp_path: Path) -> None:
    absent = tmp_path / "absent"  # hides the installed library, as if there were none
    absent.mkdir()
    for name in ("rtde_receive", "rtde_control"):
        (absent / f"{name}.py").write_text(f"raise ModuleNotFoundError('no {name}', name='{name}')\n")
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: bare\ndevices:\n  robot: {driver: ur, host: 127.0.0.9}\n")
    # In a separate process, because this one may already have imported the library.
    done = subprocess.run(
        [COMMAND, "doctor", "--rig", str(rig), "--data", str(tmp_path / "data"), "--json"],
        env={**os.environ, "PYTHONPATH": str(absent)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    error = json.loads(done.stdout)["devices"]["robot"]["error"]
    assert error["kind"] == "DriverMissingError"
    assert "ur-rtde" in error["what"]
    assert "docs/howto/installation.md" in error["remedy"]


def test_doctor_names_what_is_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rtde_control" else found(name))
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: bare\ndevices:\n  scanner: {driver: scan_folder, folder: .}\n")
    result = invoke("doctor", "--rig", rig, "--data", tmp_path / "data")
    assert result.exit_code == 0
    assert "not installed: ur-rtde" in result.output


def test_doctor_is_content_with_a_rig_that_is_well(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: bare\ndevices:\n  scanner: {driver: scan_folder, folder: scans}\n")
    result = invoke("doctor", "--rig", rig, "--data", tmp_path / "data", "--json")
    assert result.exit_code == 0
    assert answer_of(result)["devices"]["scanner"]["identity"]["kind"] == "scanner"


@pytest.mark.slow
def test_simulate_becomes_a_simulator_and_the_doctor_finds_it(tmp_path: Path) -> None:
    link = tmp_path / "lightbox"
    with subprocess.Popen(
        [COMMAND, "simulate", "lightbox", "--link", str(link)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            ready = json.loads(process.stdout.readline())
            assert ready["ready"] is True
            rig = tmp_path / "rig.yaml"
            rig.write_text("name: box\ndevices:\n  lightbox: {driver: lightbox, port: lightbox}\n")
            result = invoke("doctor", "--rig", rig, "--data", tmp_path / "data", "--json")
            assert result.exit_code == 0, result.output
            assert answer_of(result)["ok"] is True
        finally:
            os.kill(process.pid, signal.SIGTERM)
        assert process.wait(timeout=60) == 0
