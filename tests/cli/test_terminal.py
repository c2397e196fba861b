"""A person at a terminal: questions are shown, typed answers are recorded, nothing is confirmed by accident."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
from collections.abc import Generator
from pathlib import Path

import pytest

from tests.support.processes.forked import Forked
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, command, orthocapture

PROTOCOL = """
id: two_lists
version: "1"
title: Two checklists
spheres: {radius_mm: 15, registration: 10}
camera: {aperture_f: 22, exposure_s: 1/15, iso: 100}
steps:
  - id: fixation
    kind: checklist
    title: Fix the specimen
    instructions: Use two wires.
    checklist: [Two wires hold each piece]
    gates: [{measure: checklist_items_open, max: 0, unit: items}]
    sign: true
  - id: photograph_room
    kind: checklist
    title: Photograph the room
    skippable: true
"""


class Terminal:
    """A run in a pseudo-terminal."""

    def __init__(self, folder: Path) -> None:
        (folder / "p.yaml").write_text(PROTOCOL)
        (folder / "rig.yaml").write_text("name: bare\ndevices: {}\n")
        self.data = folder / "data"
        self._master, slave = pty.openpty()
        words = ["run", str(folder / "p.yaml"), "--rig", str(folder / "rig.yaml"), "--data", str(self.data)]
        self.process = Forked(
            command(*words, "--operator", "A. Tester", "--no-worker"),
            cwd=REPOSITORY, stdin=slave, stdout=slave, stderr=slave,
        )  # fmt: skip
        os.close(slave)
        self.shown = ""

    def wait_for(self, text: str) -> None:
        """Read the screen until a text appears on it."""

        def appeared() -> bool:
            while text not in self.shown and select.select([self._master], [], [], 0)[0]:
                self.shown += os.read(self._master, 65536).decode(errors="replace")
            return text in self.shown

        until(appeared, lambda: self.shown)

    def type(self, text: str) -> None:
        """Type a line; the text awaited next must appear after it."""
        self.shown = ""
        os.write(self._master, text.encode() + b"\n")

    def close(self) -> None:
        """End what is left."""
        self.process.kill()
        self.process.wait()
        os.close(self._master)


@pytest.fixture
def terminal(tmp_path: Path) -> Generator[Terminal]:
    """A run that waits for its first answer."""
    opened = Terminal(tmp_path)
    try:
        yield opened
    finally:
        opened.close()


@pytest.mark.slow
def test_a_run_by_hand(terminal: Terminal) -> None:
    terminal.wait_for("Specimen, name or number")
    terminal.type("Spine 9")
    terminal.wait_for("Two wires hold each piece")
    terminal.type("")
    terminal.wait_for("is not possible now")
    terminal.type("skip because I can")
    terminal.wait_for("is not possible now")
    terminal.type("confirm")
    terminal.wait_for("Type one of: sign")
    terminal.type("sign fixation was inspected")
    terminal.wait_for("Photograph the room")
    terminal.type("skip the camera is in the other room")
    terminal.wait_for("is completed")
    assert terminal.process.wait(timeout=30) == 0

    answer = orthocapture("status", "latest", "--data", str(terminal.data), "--json")
    status = json.loads(answer.stdout)
    assert status["status"] == "completed"
    assert dict(status["about"])["specimen"] == "Spine 9"
    assert any("other room" in text for text in status["deviations"])
    shown = orthocapture("audit", "show", "latest", "--data", str(terminal.data), "--json").stdout
    actions = [e for e in json.loads(shown)["events"] if e["kind"] == "operator_action"]
    assert [e["actor"] for e in actions] == ["A. Tester"] * 3
    assert "fixation was inspected" in json.dumps(actions)


def test_another_terminal_answers_and_aborts(terminal: Terminal) -> None:
    terminal.wait_for("Specimen, name or number")
    terminal.type("Spine 9")
    terminal.wait_for("Two wires hold each piece")
    data = str(terminal.data)
    answer = orthocapture("act", "confirm", "--data", data, "--operator", "B. Other")
    assert answer.returncode == 0, answer.stderr
    terminal.wait_for("Type one of: sign")
    refused = orthocapture("act", "skip", "--data", data, "--reason", "no time", "--operator", "B. Other")
    assert refused.returncode == 1
    assert (
        orthocapture("act", "abort", "--data", data, "--reason", "specimen fell", "--operator", "B. Other").returncode
        == 0
    )
    terminal.wait_for("is aborted")
    assert terminal.process.wait(timeout=30) == 1


def test_ctrl_c_leaves_the_run_and_says_how_it_goes_on(terminal: Terminal) -> None:
    terminal.wait_for("Specimen, name or number")
    terminal.type("Spine 9")
    terminal.wait_for("Two wires hold each piece")
    terminal.process.send_signal(signal.SIGINT)
    terminal.wait_for("Continue it with: orthocapture resume")
    assert terminal.process.wait(timeout=30) != 0
    status = json.loads(orthocapture("status", "latest", "--data", str(terminal.data), "--json").stdout)
    assert status["status"] not in ("completed", "aborted")
