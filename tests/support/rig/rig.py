"""Runs a simulated rig and the command line as processes, for system tests."""

from __future__ import annotations

import fcntl
import json
import socket
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.processes.forked import Forked, run
from tests.support.rig.patience import PATIENCE_S

REPOSITORY = Path(__file__).parents[3]


class RigLock:
    """Only one rig at a time per address, because RTDE's ports are fixed."""

    def __init__(self, host: str) -> None:
        self._path = Path(tempfile.gettempdir()) / f"orthocapture-test-rig-{host}.lock"

    def __enter__(self) -> None:
        self._file = self._path.open("w")
        fcntl.flock(self._file, fcntl.LOCK_EX)

    def __exit__(self, *_exc: object) -> None:
        self._file.close()


_USUAL = "127.0.0.1"
RIG_LOCK = RigLock(_USUAL)


def press_pedal(world: str) -> None:
    """Press the foot pedal of the rig whose world listens at `world`."""
    host, _, port = world.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=90) as link:
        link.sendall(b'{"op": "act", "action": "press_pedal"}\n')
        assert json.loads(link.makefile().readline())["ok"]


def orthocapture(*words: str, timeout_s: float = 120) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    return run(command(*words), cwd=REPOSITORY, timeout_s=timeout_s)


def command(*words: str) -> list[str]:
    """The command line that corresponds to an installed `orthocapture`."""
    return [sys.executable, "-m", "service.cli.main", *words]


@contextmanager
def simulated_rig(
    folder: Path,
    *options: str,
    host: str = _USUAL,
    patience_s: float = PATIENCE_S,
    start: type[subprocess.Popen[str]] = Forked,
) -> Generator[dict[str, Any]]:
    """Start a rig around one scene; yields its ready line. On another loopback address it waits for no other rig.

    Its limits are patient, since a busy machine is no dead link; `patience_s=0` is for tests of the limits. With
    `start=subprocess.Popen`, it and its devices are real starts, with command lines of their own.
    """
    words = ("--dir", str(folder), "--host", host, "--patience", str(patience_s))
    with RigLock(host), (folder / "rig.log").open("w") as log:
        process = start(
            [sys.executable, "-m", "simulators", "rig", *words, *options],
            cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line, (folder / "rig.log").read_text()
            yield json.loads(line)
        finally:
            process.terminate()
            process.wait(timeout=90)
            if process.stdout is not None:
                process.stdout.close()


def without_calibration_and_ct(capture_step: dict[str, Any]) -> None:
    """Adapt a capture step of demo.yaml to a protocol without calibration and CT."""
    capture_step["params"].pop("live", None)
    measured_from_them = ("optics_departures", "predicted_target_error_mm", "specimen_coverage")
    capture_step["gates"] = [gate for gate in capture_step["gates"] if gate["measure"] not in measured_from_them]
