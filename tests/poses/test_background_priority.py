"""Background computations let the processes of a capture go first, also where sessions get equal shares."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.support.rig.rig import REPOSITORY

_SESSION = Path("/proc/self/autogroup")
_SAYS = (
    "import os; from pathlib import Path; from service.compute.priority import compute_in_background;"
    "compute_in_background(); session = Path('/proc/self/autogroup');"
    "print(os.nice(0), session.read_text().split()[-1] if session.exists() else 10)"
)


def said(*, leads_a_session: bool) -> list[int]:
    """Niceness of a process in the background, and of its session."""
    made = subprocess.run(
        [sys.executable, "-c", _SAYS], cwd=REPOSITORY, start_new_session=leads_a_session, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return [int(word) for word in made.stdout.split()]


def test_a_session_of_its_own_is_lowered_with_the_process() -> None:
    assert said(leads_a_session=True) == [min(19, os.nice(0) + 10), 10]


def test_the_session_of_other_programs_is_left_alone() -> None:
    before = int(_SESSION.read_text().split()[-1]) if _SESSION.exists() else 10
    assert said(leads_a_session=False) == [min(19, os.nice(0) + 10), before]
