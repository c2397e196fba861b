"""Turns of phrase of this house are counted, and `make lint` fails when a count has risen."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.support.rig.rig import REPOSITORY
from tests.support.suite.dialect import FOLDERS, TICS, places_in

SCRIPT = ("bench/__init__.py", "bench/machine.py", "bench/suite/dialect.py", "tests/support/suite/dialect.py")
SOURCE = '''"""A module."""


def told(form: str, *, folder: str) -> str:
    """Of the step.

    Args:
        form: how it is written.
        folder: for its files.
    """
    for one in form:
        print(f"{one} is kept here")
    return form


def report(name: str) -> str:
    """Return the name as it is reported."""
    return name
'''


def tree_with(folder: Path, source: str) -> Path:
    """A repository whose only module has this source."""
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    (folder / "service" / "module.py").write_text(source)
    return folder


def test_each_turn_of_phrase_is_found_with_its_line(tmp_path: Path) -> None:
    found = places_in(["service"], tree_with(tmp_path, SOURCE))
    assert {tic: [place.line for place in places] for tic, places in found.items()} == {
        "preposition": [4, 4],
        "participle": [4],
        "for-one-in": [11],
        "house-name": [4, 4],
        "house-text": [12],
    }
    plain = tree_with(tmp_path, SOURCE[SOURCE.index("def report") :])
    assert {tic: len(places) for tic, places in places_in(FOLDERS, plain).items()} == dict.fromkeys(TICS, 0)


def test_the_check_fails_when_a_count_rises_and_the_list_follows_what_falls(tmp_path: Path) -> None:
    tree_with(tmp_path, SOURCE)
    for name in SCRIPT:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, tmp_path / name)

    def dialect(*words: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        return subprocess.run(
            [sys.executable, "-m", "bench.suite.dialect", *words],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip

    assert dialect("--renew").returncode == 0
    assert dialect("--check").returncode == 0
    tree_with(tmp_path, SOURCE.replace("def report", "def added"))
    risen = dialect("--check")
    assert risen.returncode == 1
    assert "participle in service: 2, and 1 stand" in risen.stderr
    assert "service/module.py:16: added" in dialect("--list", "participle").stdout
    tree_with(tmp_path, SOURCE.replace("for one in", "for letter in"))
    assert dialect("--renew").returncode == 0
    tree_with(tmp_path, SOURCE)
    assert "for-one-in in service: 1, and 0 stand" in dialect("--check").stderr
    assert dialect("--renew", "--higher").returncode == 0
    assert dialect("--check").returncode == 0


def test_the_list_of_the_repository_names_every_turn_and_every_folder() -> None:
    listed = json.loads((REPOSITORY / "bench/suite/dialect.json").read_text(encoding="utf-8"))
    assert {tic: set(rooms) for tic, rooms in listed.items()} == {tic: set(FOLDERS) for tic in TICS}
