"""A run that nobody attends ends with a status of its own where a person must decide, and can be resumed."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from service.cli.ending import ExitStatus
from service.cli.main import app
from service.cli.operators import AutomaticOperator, Display, SimulatedHands, TerminalOperator
from service.cli.terminal_output import Terminal
from service.core.errors import PersonNeededError
from service.core.records.entered import REASON_CHARACTERS
from service.core.records.run_events import OperatorAction, StepFailed
from service.core.run.decide import AskOperator
from service.monitor.reporter import OpenDevices, Reporter
from service.store.store import Store
from tests.support.record.core import Log, toy_protocol
from tests.support.rig.bench_rig import BenchCamera

HEAD = """\
id: one
version: "1"
title: One list
spheres: {radius_mm: 15, registration: 10}
camera: {aperture_f: 22, exposure_s: 1/15, iso: 100}
steps:
"""
# A figure outside its limits; a device that the rig does not have; and a technician who does not answer.
STEPS = {
    "gate": "kind: checklist, checklist: [it holds], gates: [{measure: checklist_items_open, min: 1}]",
    "device": "kind: layout_check, gates: [{measure: spheres_seen, min: 10}]",
    "hands": "kind: checklist, checklist: [it holds], simulated_hands: [{action: mount_camera}]",
}
WORDS = {"gate": "Outside its limits", "device": "exactly one camera", "hands": "does not answer"}


def invoke(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def begin(folder: Path, step: str, *options: str) -> Result:
    (folder / "p.yaml").write_text(f"{HEAD}  - {{id: a, title: A, {STEPS[step]}}}\n")
    hands = "hands: 127.0.0.1:9\n" if step == "hands" else ""
    (folder / "rig.yaml").write_text(f"name: bare\nsimulated: true\n{hands}devices: {{}}\n")
    return invoke(
        "run", folder / "p.yaml", "--rig", folder / "rig.yaml", "--data", folder / "data", "--operator", "Ada",
        "--auto-confirm", "--no-worker", *options,
    )  # fmt: skip


@pytest.mark.parametrize("step", STEPS)
def test_a_question_that_only_a_person_can_answer_has_a_status_of_its_own(tmp_path: Path, step: str) -> None:
    ended = begin(tmp_path, step)
    assert ended.exit_code == ExitStatus.WAITS_FOR_A_PERSON == 75
    assert WORDS[step] in ended.stderr
    assert "Resume the run without --auto-confirm and decide" in ended.stderr
    with Store.open(tmp_path / "data") as store:
        (run,) = store.runs()
        assert run.run_id in store.open_runs(), "only a person ends a run"
    again = invoke("resume", "latest", "--data", tmp_path / "data", "--auto-confirm", "--no-worker", "--json")
    assert again.exit_code == 75, "a loop that resumes meets the same question"


def test_the_status_is_in_the_json_with_the_run_and_the_question(tmp_path: Path) -> None:
    ended = begin(tmp_path, "gate", "--json")
    assert ended.exit_code == 75
    answer = json.loads(ended.stdout)
    with Store.open(tmp_path / "data") as store:
        (run,) = store.runs()
    assert answer["exit_status"] == 75
    assert answer["error"]["kind"] == "PersonNeededError"
    assert answer["error"]["where"] == f"run {run.run_id}, step a"
    assert "Outside its limits" in answer["error"]["what"]


@pytest.mark.parametrize("command", ["run", "resume"])
def test_the_help_states_it(command: str) -> None:
    told = " ".join(invoke(command, "--help").stdout.replace("│", " ").split())
    assert "75" in told
    assert "a person must decide" in told


def test_an_ordinary_error_has_status_1_as_before(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("name: bare\nsimulated: true\ndevices: {}\n")
    ended = invoke(
        "run", tmp_path / "none.yaml", "--rig", tmp_path / "rig.yaml", "--data", tmp_path / "data", "--auto-confirm",
        "--json",
    )  # fmt: skip
    assert ended.exit_code == 1
    assert "exit_status" not in json.loads(ended.stdout)


@pytest.fixture
def display(tmp_path: Path) -> Display:
    reporter = Reporter(tmp_path, "run", lambda: OpenDevices({}, {}, {}), lambda _name: BenchCamera())
    return Display(Terminal(stderr=True), reporter)


def test_a_killed_driver_or_a_starved_machine_ends_an_unattended_run_with_it(display: Display) -> None:
    for error in ("DriverKilledError", "MachineBusyError", "UnforeseenError"):
        log = Log(toy_protocol())
        log.begin()
        log.append(StepFailed(step="fix_it", attempt=1, error=error, message="m", recovery="ask"))
        operator = AutomaticOperator("Ada", log.protocol, display, SimulatedHands(None))
        assert isinstance(log.decision, AskOperator)
        with pytest.raises(PersonNeededError, match=error):
            operator.poll(log.decision, log.state)


def test_a_record_that_cannot_be_written_is_waited_for_for_two_minutes(display: Display) -> None:
    operator = AutomaticOperator("Ada", toy_protocol(), display, SimulatedHands(None))
    operator.stuck("No space left on device", 119.0)
    with pytest.raises(PersonNeededError, match="No space left on device"):
        operator.stuck("No space left on device", 121.0)


def test_a_terminal_that_was_closed_has_it_too(display: Display) -> None:
    log = Log(toy_protocol())
    reading, writing = os.pipe()
    os.close(writing)
    operator = TerminalOperator("Ada", log.protocol, display, SimulatedHands(None), descriptor=reading)
    with pytest.raises(PersonNeededError, match="the terminal was closed"):
        operator.poll(log.question, log.state)
    os.close(reading)


def test_what_is_typed_as_a_reason_has_the_same_limits_as_everywhere(display: Display) -> None:
    log = Log(toy_protocol())
    reading, writing = os.pipe()
    operator = TerminalOperator("Ada", log.protocol, display, SimulatedHands(None), descriptor=reading)
    os.write(writing, b"abort " + (REASON_CHARACTERS + 1) * b"x" + b"\n" + b"abort it fell\n")
    assert operator.poll(log.question, log.state) is None, "it asks again"
    answer = operator.poll(log.question, log.state)
    assert isinstance(answer, OperatorAction)
    assert (answer.action, answer.reason) == ("abort", "it fell")
    os.close(reading)
    os.close(writing)
