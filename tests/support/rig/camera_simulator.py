"""Runs the simulated camera as a child process for tests."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tests.support.processes.forked import Forked


@dataclass
class RunningCamera:
    process: subprocess.Popen[str]
    port: int

    @property
    def gphoto_port(self) -> str:
        return f"ptpip:127.0.0.1:{self.port}:{self.port}"


@contextmanager
def camera_simulator(
    faults: Sequence[dict[str, Any]] = (), *options: str, port: int = 0, width: int = 480, name: str = "camera"
) -> Generator[RunningCamera]:
    command = [sys.executable, "-m", "simulators", name, "--port", str(port), "--image-width", str(width)]
    command += [
        "--parent",
        str(os.getpid()),
        "--faults",
        json.dumps([{"device": "camera", **fault} for fault in faults]),
        *options,
    ]
    with Forked(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            ready = json.loads(process.stdout.readline())
            assert ready["ready"] is True
            yield RunningCamera(process, ready["port"])
        finally:
            process.terminate()
            process.wait(90)
