"""The machine dies in the middle of a capture: the run continues in the folder restored from the last backup."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from service.core.records.run_events import ViewpointCaptured
from service.store.store import Store
from tests.support.processes.started import started
from tests.support.processes.waiting import until
from tests.support.protocols.short_protocol import short_protocol
from tests.support.rig.rig import orthocapture, simulated_rig

pytestmark = [pytest.mark.timeout(400), pytest.mark.sqlite("backups and journal: a server has its own")]
VIEWS = 12


def captured(data: Path) -> list[str]:
    """The viewpoints of the run, in order."""
    if not (data / "orthocapture.sqlite").exists():
        return []
    with Store.open(data) as store:
        runs = store.runs()
        payloads = [event.payload for event in store.events(runs[-1].run_id)] if runs else []
    return [payload.viewpoint for payload in payloads if isinstance(payload, ViewpointCaptured)]


def wait_for_captures(data: Path, count: int, runner: subprocess.Popen[bytes], log: Path) -> None:
    def there() -> bool:
        assert runner.poll() is None, log.read_text()
        return len(captured(data)) >= count

    until(there, log.read_text, 120)


@pytest.mark.slow
@pytest.mark.sweep  # on the bench: test_backup.py
def test_a_run_is_backed_up_in_its_capture_and_finished_where_it_was_restored(tmp_path: Path) -> None:
    data, restored = tmp_path / "data", tmp_path / "restored"
    with simulated_rig(
        tmp_path, "--scene", "3", "--image-width", "320", "--speed-up", "2", host="127.0.0.34"
    ) as ready:
        words = [
            "run",
            str(short_protocol(tmp_path, views=VIEWS)),
            "--rig",
            ready["rig"],
            "--data",
            str(data),
            "--auto-confirm",
            "--no-worker",
        ]
        with started(words, tmp_path / "run.log") as runner:
            wait_for_captures(data, 2, runner, tmp_path / "run.log")
            made = orthocapture("store", "backup", str(tmp_path / "backup"), "--data", str(data), "--json")
            assert made.returncode == 0, made.stdout + made.stderr
            wait_for_captures(data, len(captured(data)) + 1, runner, tmp_path / "run.log")
            runner.kill()
            runner.wait(timeout=60)
        lost = captured(data)
        back = orthocapture("store", "restore", str(tmp_path / "backup"), str(restored), "--json")
        assert back.returncode == 0, back.stdout + back.stderr
        assert json.loads(back.stdout)["faults"] == []
        verified = orthocapture("audit", "verify", "all", "--data", str(restored), "--json")
        assert json.loads(verified.stdout)["ok"], verified.stdout
        kept = captured(restored)
        assert 2 <= len(kept) < len(lost)
        assert kept == lost[: len(kept)]

        rotated = orthocapture("audit", "rotate-key", "--lost", "--reason", "test", "--data", str(restored))
        assert rotated.returncode == 0, rotated.stderr
        again = orthocapture(
            "resume", "latest", "--data", str(restored), "--auto-confirm", "--no-worker", timeout_s=300
        )
        assert again.returncode == 0, again.stdout + again.stderr
    after = captured(restored)
    assert after[: len(kept)] == kept
    assert sorted(after) == [f"v1_{i:03d}" for i in range(1, VIEWS + 1)]
    assert orthocapture("audit", "verify", "all", "--data", str(restored)).returncode == 0
    logged = [json.loads(line) for line in (restored / "logs" / "orthocapture.jsonl").read_text().splitlines()]
    shots = [line["viewpoint"] for line in logged if line["event"] == "viewpoint_captured"]
    assert shots == after[len(kept) :]
    assert {"runner", "driver robot"} <= {line["process"] for line in logged}
