"""Output in a terminal of 80 columns: no lost word, no truncated number, one style of help, suggested names."""

from __future__ import annotations

import io
import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import pytest
from rich.table import Table
from typer.testing import CliRunner

from service.benchmark.methods import methods
from service.cli.common import print_table
from service.cli.demo import free_address
from service.cli.main import app
from service.cli.operators import Display, SimulatedHands, TerminalOperator
from service.cli.terminal_output import Terminal
from service.computations import term
from service.compute.matching.methods import matchers
from service.core.protocol import irreversible_warning, load_protocol
from service.core.run.decide import AskOperator
from service.dataset.exporter import exporters
from service.steps import params_models
from service.steps.live_numbers import seen_words
from tests.support.processes.forked import Forked

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).with_name("orthocapture")


def _output(*words: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, list(words), catch_exceptions=False)
    return done.exit_code, done.output


def _completed(words: str, at: int) -> list[str]:
    """What the command offers a shell that asks how the word at a place goes on."""
    asked = {"_ORTHOCAPTURE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(at)}
    done = subprocess.run(
        [COMMAND],
        env={**os.environ, "COLUMNS": "80", **asked},
        capture_output=True,
        text=True,
        timeout=100,
        check=True,
    )
    return done.stdout.split()


def _plain(shown: str) -> str:
    """The displayed text as running words, without the box around it."""
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", shown).split())


@pytest.mark.parametrize("columns", [80, 60, 132])
def test_no_word_of_an_instruction_is_lost(columns: int) -> None:
    protocol = load_protocol(ROOT / "protocols" / "exvivo_spine.yaml", params_models()).protocol
    shown = io.StringIO()
    console = Terminal(file=shown, width=columns)
    nobody_types, _ = os.pipe()
    reporter = cast(Any, None)
    operator = TerminalOperator("A. Tester", protocol, Display(console, reporter), SimulatedHands(None), nobody_types)
    for step in protocol.steps:
        question = AskOperator(
            step=step.id, for_="confirm", text=f"{step.instructions} [bold] 90° [/] it", options=("confirm",),
            checklist=step.checklist,
        )  # fmt: skip
        shown.truncate(0)
        shown.seek(0)
        operator.print_question(question)  # as shown by the poll, but without a terminal
        assert max(map(len, shown.getvalue().splitlines())) <= columns
        words = _plain(shown.getvalue())
        warning = [irreversible_warning(protocol, step)] if step.irreversible else []
        for text in (step.title, step.why, question.text, *step.checklist, *warning):
            assert " ".join(text.split()) in words


def _shown_table(*, terminal: bool) -> str:
    shown = io.StringIO()
    table = Table("", "x mm", "y mm", "z mm", "sigma mm", "what")
    table.add_row("0", "-5895.842", "-12345.678", "99999.123", "0.0001", "a long word on where this lies in the hall")
    print_table(table, Terminal(file=shown, width=40, force_terminal=terminal))
    return shown.getvalue()


def test_a_table_never_cuts_a_number() -> None:
    for terminal in (True, False):
        for number in ("-5895.842", "-12345.678", "99999.123", "0.0001"):
            assert number in _shown_table(terminal=terminal)
        assert "…" not in _shown_table(terminal=terminal)
    assert "a long word on where this lies in the hall" in _shown_table(terminal=False)


@pytest.mark.parametrize(("typed", "meant"), [("registr", "register"), ("stat", "status"), ("calibate", "calibrate")])
def test_a_command_typed_wrongly_is_answered_with_a_near_one(typed: str, meant: str) -> None:
    status, words = _output(typed)
    assert status == 2
    assert f"Did you mean '{meant}'?" in _plain(words)


def test_every_command_is_named_in_the_help_and_the_version_is_told() -> None:
    _, words = _output("--help")
    for name in ("calibrate", "plan", "audit", "store", "protocol"):
        assert re.search(rf"│ {name} +\w", words)
    assert re.fullmatch(r"orthocapture \d+\.\d+\.\d+\S*\n", _output("--version")[1])


def test_the_help_groups_every_command_by_what_it_is_for() -> None:
    _, shown = _output("--help")
    titles = re.findall(r"╭─ (.+?) ─+╮", shown)
    assert titles == [
        "Options",
        "Capture",
        "Evidence and data sets",
        "Calibration and computing",
        "Site",
        "Development",
    ]
    listed = re.findall(r"(?m)^│ ([a-z][a-z-]*) +\S", shown)
    assert len(listed) == len(set(listed))
    documented = (ROOT / "docs/reference/commands.md").read_text()
    assert set(listed) == set(re.findall(r"(?m)^## orthocapture ([a-z-]+)$", documented))
    assert all(len(line) <= 80 for line in shown.splitlines())


@pytest.mark.slow
def test_the_shell_completes_commands() -> None:
    assert _completed("orthocapture re", 1) == ["resume", "replay", "register"]
    assert _completed("orthocapture calibrate ", 2) == ["intrinsics", "hand-eye"]


def test_simulators_explain_themselves_as_every_command_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", Forked)
    status, shown = _output("simulate", "rig", "--help")
    assert status == 0
    assert "Usage: orthocapture simulate rig [OPTIONS]" in shown
    assert "╭─ Options" in shown
    for words in ("--scene", "--image-width", "--speed-up", "seed of the scene"):
        assert words.lower() in shown.lower()
    _, everything = _output("simulate", "--help")
    for name in ("ur", "camera", "scanner", "ct", "lightbox", "rig"):
        assert re.search(rf"│ {name} +[AT]", everything)


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (["rig", "--scene", "x", "--dir", "d"], "Invalid value for '--scene'"),
        (["rig", "--scene", "7"], "Missing option '--dir'"),
        (["rig", "--scen", "7", "--dir", "d"], "No such option: --scen (Possible options: --scanner, --scene)"),
        (["rig", "--scene", "7", "--dir", "d", "--arms", "3"], "'3' is not one of '1', '2'"),
        (["camera", "--image", "a.jpg", "b.jpg", "--bogus"], "No such option: --bogus"),
        (["lightbocks"], "No such simulator 'lightbocks'. Did you mean 'lightbox'?"),
        (
            ["--bogus"],
            "Which one? There are ur, kuka, camera, canon, nikon, gige, video, scanner, ct, lightbox, rig, grbl",
        ),
    ],
)
def test_a_simulator_refuses_wrong_usage_as_every_command_does(
    typed: list[str], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subprocess, "Popen", Forked)  # the command asks a process of its own for the options
    status, shown = _output("simulate", *typed)
    assert status == 2
    assert "╭─ Error" in shown
    assert told in _plain(shown)


def test_a_missing_rig_file_says_what_to_do(tmp_path: Path) -> None:
    status, words = _output("doctor", "--rig", str(tmp_path / "rig.yaml"))
    assert status == 1
    assert "docs/howto/your_hardware.md" in words
    assert "orthocapture simulate rig --scene 7 --dir rig" in words


def test_an_arm_is_named_from_a_list() -> None:
    _, words = _output("calibrate", "hand-eye", "--help")
    for model in ("UR10e", "UR5e", "UR3e"):
        assert model in words


def test_the_demo_goes_where_the_arms_ports_are_free() -> None:
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        first = free_address()
        taken.bind((first, 30004))
        taken.listen()
        assert free_address() != first


def test_names_of_the_record_are_words() -> None:
    assert term("ct_surface") == "CT surface"
    assert seen_words(9, 10) == "9/10 spheres"
    assert seen_words(13, 10) == "13 spheres (10 expected in this image)"
    assert json.dumps(seen_words(3, None)) == '"3 spheres"'


@pytest.mark.parametrize(
    ("command", "option", "named"),
    [
        (("export",), "--format", exporters),
        (("benchmark", "run"), "--method", methods),
        (("benchmark", "matching"), "--method", matchers),
    ],
)
def test_the_help_names_every_format_and_method(
    command: tuple[str, ...], option: str, named: Callable[[], Mapping[str, object]]
) -> None:
    help_text = re.sub(r"[│\s]+", " ", _output(*command, "--help")[1])
    listed = help_text.split(option, 1)[1].split("or that of a plug-in", 1)[0]
    assert set(named()) <= set(re.findall(r"[a-z0-9-]+", listed))
