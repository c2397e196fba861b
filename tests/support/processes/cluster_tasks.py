"""Tasks that a test sends to a cluster: each is found by its name on the other side."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from service.core.errors import DataError


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


def copy_end(files: tuple[Path, Path]) -> tuple[Path, str, list[str]]:
    """Write a file's last bytes to another path; return that path, also as a text, and the names in its folder."""
    source, target = files
    target.write_bytes(source.read_bytes()[-1000:])
    return target, f"written: {target}", sorted(file.name for file in target.parent.iterdir())


def extend(file: Path) -> int:
    """Add to a file, and return its size."""
    with file.open("ab") as output:
        output.write(b", more")
    return file.stat().st_size


def refuse(file: Path) -> None:
    """Read a file, and refuse it. Raises DataError."""
    raise DataError(f"{file} has {len(file.read_bytes())} bytes", where=str(file))
