"""The processes below another one, with their command lines: any of them may end while one looks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import psutil


def processes_below(
    wanted: Callable[[list[str]], bool], root: psutil.Process | None = None, *, recursive: bool = True
) -> list[psutil.Process]:
    """Return those whose command line is wanted; `root` None: those below this process."""
    found: list[psutil.Process] = []
    for process in (root or psutil.Process()).children(recursive=recursive):
        with contextlib.suppress(psutil.NoSuchProcess):  # it ended meanwhile: a zombie counts as such
            if wanted(process.cmdline()):
                found.append(process)
    return found
