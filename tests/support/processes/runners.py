"""Ends the runners that a web process has started, which outlive it."""

from __future__ import annotations

import json
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

_GRACE_S = 20.0


def end_runners(data: Path) -> None:
    """Terminate the processes that drive runs of a data folder, and wait for them."""
    for path in (data / "monitor").glob("*.json"):
        pid = json.loads(path.read_text()).get("pid")
        if pid is None:  # this is a verification's result
            continue
        with suppress(psutil.NoSuchProcess):
            runner = psutil.Process(pid)
            runner.terminate()
            deadline_s = time.monotonic() + _GRACE_S
            while runner.status() != psutil.STATUS_ZOMBIE and time.monotonic() < deadline_s:
                time.sleep(0.1)


@contextmanager
def no_runner_left(data: Path) -> Generator[None]:
    """At the end of the block, end the runners of a data folder, so that they don't keep devices of later tests."""
    try:
        yield
    finally:
        end_runners(data)
