"""A run that is killed during the viewpoint capture continues at the next viewpoint."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pytest
import yaml

from service.core.errors import OrthocaptureError
from service.core.records.run_events import SessionStarted, ViewpointCaptured
from service.store.database.opening import has_database
from service.store.store import Store
from tests.support.arms.arm_watch import watched_arm
from tests.support.processes.started import started
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, orthocapture, simulated_rig, without_calibration_and_ct

pytestmark = [pytest.mark.timeout(400)]
HOST = "127.0.0.31"
T = TypeVar("T")


def short_protocol(folder: Path) -> Path:
    """The capture of station 1 alone, six viewpoints."""
    protocol = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    capture = next(s for s in protocol["steps"] if s["id"] == "viewpoint_capture_1")
    capture["params"]["viewpoints"][0]["arcs"] = [
        {"tilt_deg": 25, "azimuth_from_deg": -40, "azimuth_to_deg": 40, "count": 6, "distance_m": 0.62}
    ]
    capture["gates"][0]["min"] = 6
    without_calibration_and_ct(capture)
    protocol["steps"] = [capture]
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump(protocol))
    return path


@pytest.mark.slow
def test_sigkill_in_the_capture_loses_and_repeats_nothing(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with simulated_rig(tmp_path, "--scene", "3", "--image-width", "320", "--speed-up", "3", host=HOST) as ready:
        words = [
            "run",
            str(short_protocol(tmp_path)),
            "--rig",
            ready["rig"],
            "--data",
            str(data),
            "--auto-confirm",
            "--no-worker",
        ]
        with started(words, tmp_path / "run.log") as runner:
            wait_for_captures(data, 2, runner, tmp_path / "run.log")
            os.kill(runner.pid, signal.SIGKILL)
            runner.wait(timeout=60)
        before, sessions = captured(data), len(recorded(data, SessionStarted))
        assert 2 <= len(before) < 6

        words = ["resume", "latest", "--data", str(data), "--screens", "--no-worker"]
        with started(words, tmp_path / "resume.log") as again, watched_arm(HOST) as arm:
            wait_for(lambda: len(recorded(data, SessionStarted)) > sessions, again, tmp_path / "resume.log")
            arm.wait_resting()
            rested = arm.mark()
            arm.pass_s(3.0)
            assert arm.moved_for_s(rested) == 0.0, "the arm moves for nobody"
            assert captured(data) == before
            answer = orthocapture("act", "confirm", "--data", str(data), "--operator", "Grace")
            assert answer.returncode == 0, answer.stdout + answer.stderr
            assert again.wait(timeout=240) == 0, (tmp_path / "resume.log").read_text()
    shown = events(data)
    released = next(e for e in shown if e["kind"] == "operator_action" and e["actor"] == "Grace")
    assert [e["seq"] > released["seq"] for e in shown if e["kind"] == "viewpoint_captured"].index(True) == len(before)
    after = captured(data)
    assert after[: len(before)] == before
    names = [event["artefacts"][0]["viewpoint"] for event in after]
    assert names == [f"v1_{i:03d}" for i in range(1, 7)]
    assert len({event["artefacts"][0]["sha256"] for event in after}) == 6
    assert orthocapture("audit", "verify", "latest", "--data", str(data)).returncode == 0


def wait_for_captures(data: Path, count: int, runner: subprocess.Popen[bytes], log: Path) -> None:
    wait_for(lambda: len(recorded(data, ViewpointCaptured)) >= count, runner, log)


def wait_for(reached: Callable[[], bool], runner: subprocess.Popen[bytes], log: Path) -> None:
    def alive_and_reached() -> bool:
        assert runner.poll() is None, log.read_text()
        return reached()

    until(alive_and_reached, log.read_text, 180.0, every_s=0.1)


def recorded(data: Path, kind: type[T]) -> list[T]:
    """What the record holds of this kind so far, read in this process, which costs much less than a command."""
    if not has_database(data):
        return []
    try:
        with Store.open(data, create=False) as store:
            found = [event.payload for run in store.runs() for event in store.events(run.run_id)]
    except OrthocaptureError:  # it is being made
        return []
    return [payload for payload in found if isinstance(payload, kind)]


def captured(data: Path) -> list[dict[str, Any]]:
    """The capture events so far."""
    return [event for event in events(data) if event["kind"] == "viewpoint_captured"]


def events(data: Path) -> list[dict[str, Any]]:
    """The events so far, as an auditor reads them."""
    if not has_database(data):
        return []
    answer = orthocapture("audit", "show", "latest", "--data", str(data), "--json")
    if answer.returncode != 0:
        return []
    return json.loads(answer.stdout)["events"]
