"""A run whose driver the system killed waits for a person, and goes on with little processor time and memory."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from service.cli.ending import ExitStatus
from service.cli.run import end_with_children
from service.core.records.run_events import DeviceTrouble, RunCompleted, SessionStarted, StepFailed
from tests.recovery.test_resume import captured, recorded, short_protocol, wait_for, wait_for_captures
from tests.support.processes.below import processes_below
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, command, orthocapture, simulated_rig

pytestmark = [pytest.mark.timeout(800)]
HOST = "127.0.0.32"
MEMORY_BYTES = 600_000_000  # of data, for each process
# Low priority on one processor, which another wants as well, and little memory; its drivers inherit all of it.
PRESSED = (
    "import os, resource, sys\n"
    "os.nice(5)\n"
    "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    f"resource.setrlimit(resource.RLIMIT_DATA, ({MEMORY_BYTES}, {MEMORY_BYTES}))\n"
    "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])\n"
)
RIVAL = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass\n"


@contextmanager
def begun(words: list[str], log: Path, *before: str) -> Generator[subprocess.Popen[bytes]]:
    """The command as a real start, so that its drivers can be told from its other processes."""
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, *before, *command(*words)[1:]],
            cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
        )  # fmt: skip
    try:
        yield process
    finally:
        end_with_children(process, 30.0)


@contextmanager
def pressed(words: list[str], log: Path) -> Generator[subprocess.Popen[bytes]]:
    """The command on a machine that has little for it."""
    with ExitStack() as stack:
        rival = stack.enter_context(subprocess.Popen([sys.executable, "-c", RIVAL]))
        stack.callback(rival.kill)
        yield stack.enter_context(begun(words, log, "-c", PRESSED))


def drivers_of(runner: subprocess.Popen[bytes]) -> list[psutil.Process]:
    return processes_below(lambda line: "drivers.host" in " ".join(line), psutil.Process(runner.pid), recursive=False)


@pytest.mark.slow
@pytest.mark.whole
def test_a_killed_driver_ends_no_run_and_it_is_resumed_on_a_pressed_machine(tmp_path: Path) -> None:
    """Other signals are told in the same way: tests/robot/test_host.py."""
    data, log = tmp_path / "data", tmp_path / "run.log"
    with simulated_rig(tmp_path, "--scene", "3", "--image-width", "320", "--speed-up", "3", host=HOST) as ready:
        words = ["run", str(short_protocol(tmp_path)), "--rig", ready["rig"], "--data", str(data)]
        with begun([*words, "--auto-confirm", "--no-worker", "--json"], log) as runner:
            wait_for_captures(data, 2, runner, log)
            drivers_of(runner)[-1].kill()
            assert runner.wait(timeout=300) == ExitStatus.WAITS_FOR_A_PERSON, log.read_text()
        before = captured(data)
        assert 2 <= len(before) < 6
        assert "SIGKILL" in recorded(data, StepFailed)[-1].message
        assert any("SIGKILL" in trouble.message for trouble in recorded(data, DeviceTrouble))
        asked = json.loads(next(line for line in log.read_text().splitlines() if line.startswith('{"error"')))
        assert asked["exit_status"] == ExitStatus.WAITS_FOR_A_PERSON
        assert "SIGKILL" in asked["error"]["what"]
        must_be_resumed(data, before, log)


def must_be_resumed(data: Path, before: list[dict[str, Any]], log: Path) -> None:
    """The run goes on once a person has confirmed, with little processor time and memory."""
    sessions = len(recorded(data, SessionStarted))
    with pressed(["resume", "latest", "--data", str(data), "--screens", "--no-worker"], log) as again:
        wait_for(lambda: len(recorded(data, SessionStarted)) > sessions, again, log)
        assert captured(data) == before, "nothing goes on before a person has confirmed"
        answer = orthocapture("act", "confirm", "--data", str(data), "--operator", "Grace")
        assert answer.returncode == 0, answer.stdout + answer.stderr
        until(lambda: again.poll() is not None, log.read_text, 400.0, every_s=0.5)
        assert again.returncode == 0, log.read_text()
    assert len(recorded(data, RunCompleted)) == 1
    after = captured(data)
    assert after[: len(before)] == before, "what was captured is kept as it was"
    assert [event["artefacts"][0]["viewpoint"] for event in after] == [f"v1_{i:03d}" for i in range(1, 7)]
    assert orthocapture("audit", "verify", "latest", "--data", str(data)).returncode == 0
