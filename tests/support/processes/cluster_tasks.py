"""Tasks that a test sends to a cluster: each is found by its name on the other side."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path


def square(number: int) -> int:
    """Return the square."""
    return number * number


def read(file: Path) -> bytes:
    """Return the content of a file."""
    return file.read_bytes()


def wait_for(task: tuple[int, Path, Path]) -> int:
    """Write into a folder that the task of a number has begun, wait for a file, and return the number."""
    number, begun, gate = task
    (begun / f"{number}-{os.getpid()}").touch()
    while not gate.exists():
        time.sleep(0.02)
    return number


def kill_once(task: tuple[int, Path]) -> int:
    """Kill this process at the first call for number 3, and return the number at all others."""
    number, folder = task
    mark = folder / "killed"
    if number == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def kill_worker(_number: int) -> None:
    """Kill the process that computes this."""
    os.kill(os.getpid(), signal.SIGKILL)
