"""How a command ends in an orderly way: on SIGTERM, and with the processes that it has started."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Generator
from contextlib import contextmanager

import psutil


@contextmanager
def sigterm_like_ctrl_c() -> Generator[None]:
    """Let SIGTERM end this block like Ctrl-C: devices and lease are released, and started processes are ended."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def end_with_children(process: subprocess.Popen[bytes] | subprocess.Popen[str], grace_s: float) -> None:
    """Terminate a process; whatever is left of it and its children after `grace_s` is killed."""
    children = _children(process)
    process.terminate()
    try:
        process.wait(timeout=grace_s)
    except subprocess.TimeoutExpired:
        children += _children(process)  # those that it has started meanwhile
        process.kill()
        process.wait()
        grace_s = 0.0
    _, left = psutil.wait_procs(children, timeout=grace_s)
    for child in left:
        child.kill()


def _children(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> list[psutil.Process]:
    if process.poll() is not None:
        return []
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []
