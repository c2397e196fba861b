"""A command of the program as a process of its own, which never outlives its test."""

from __future__ import annotations

import subprocess
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.cli.run import end_with_children
from tests.support.processes.forked import Forked
from tests.support.rig.rig import REPOSITORY, command

_GRACE_S = 30.0


@contextmanager
def started(words: Sequence[str], log: Path) -> Generator[subprocess.Popen[bytes]]:
    """Start `orthocapture WORDS` with its output in a file; at the end of the block, end it with its children.

    A runner that a failed test left behind would keep its devices, and fail the tests after it.
    """
    with log.open("wb") as output:
        process = Forked(command(*words), cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
    try:
        yield process
    finally:
        if process.poll() is None:
            end_with_children(process, _GRACE_S)
