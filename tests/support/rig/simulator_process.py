"""Runs a simulator as a child process for tests: waits for its ready line, ends it with SIGTERM."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.processes.forked import Forked

ROOT = Path(__file__).resolve().parents[3]


@dataclass(frozen=True)
class Running:
    """The process and its ready line."""

    process: subprocess.Popen[str]
    ready: dict[str, Any]


@contextmanager
def simulator(*words: str) -> Generator[Running]:
    """Run `python -m simulators WORDS…` until the block ends; its exit status must be 0."""
    command = [sys.executable, "-m", "simulators", *words]
    with Forked(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            line = process.stdout.readline()
            if not line:
                raise AssertionError(f"no ready line: {process.stderr.read()}")
            yield Running(process, json.loads(line))
            if process.poll() is None:
                process.terminate()
            assert process.wait(90) == 0, process.stderr.read()
        finally:
            if process.poll() is None:
                process.kill()
