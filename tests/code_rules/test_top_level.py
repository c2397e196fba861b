"""The top level of the repository holds what belongs there, and nothing that a command left behind."""

from __future__ import annotations

import subprocess

from tests.support.rig.rig import REPOSITORY

BELONGS = {
    ".ci", ".gitignore", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "Makefile", "README.md", "bench", "docs",
    "drivers", "protocols", "pyproject.toml", "service", "simulators", "tests",
}  # fmt: skip


def _git(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["git", "-C", str(REPOSITORY), *words], capture_output=True, text=True, timeout=30, check=False
    )


def test_the_top_level_holds_only_what_belongs_there() -> None:
    tracked = _git("ls-files")
    assert tracked.returncode == 0, tracked.stderr
    assert {path.split("/")[0] for path in tracked.stdout.splitlines()} == BELONGS


def test_a_database_that_a_command_left_there_is_not_committed() -> None:
    assert _git("check-ignore", "orthocapture.sqlite", "orthocapture.sqlite-wal").stdout.split() == [
        "orthocapture.sqlite",
        "orthocapture.sqlite-wal",
    ]
    assert _git("check-ignore", "README.md").returncode == 1
