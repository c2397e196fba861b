"""What is installed of a method of reconstruction: versions of packages, a commit, the first line of a program."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

_ANSWER_S = 120.0


def of_packages(*names: str) -> Callable[[], str]:
    """Return a function that gives the versions of those of these distributions that are installed."""

    def versions() -> str:
        found: list[str] = []
        for name in names:
            with contextlib.suppress(PackageNotFoundError):
                found.append(f"{name} {version(name)}")
        return ", ".join(found)

    return versions


def commit_in(variable: str) -> Callable[[], str]:
    """Return a function that gives the commit of the source folder that an environment variable names."""

    def head() -> str:
        return first_line("git", "-C", os.environ.get(variable, ""), "rev-parse", "HEAD")

    return head


def first_line(*command: str) -> str:
    """Return the first line that a program prints; "" if it does not answer."""
    try:
        printed = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return next(iter(printed.stdout.strip().splitlines()), "")
