"""Background computations let the processes of a capture go first, also where sessions get equal shares."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.support.rig.rig import REPOSITORY

_SAYS = (
    "import os; from service.compute.priority import compute_in_background; from tests.poses.test_background_priority"
    " import of_the_session; compute_in_background(); print(os.nice(0), of_the_session())"
)


def of_the_session() -> int | None:
    """Niceness of this process' session; None where sessions are not scheduled as groups (an empty file)."""
    group = Path("/proc/self/autogroup")
    words = group.read_text(encoding="ascii").split() if group.exists() else []
    return int(words[-1]) if words else None


def said(*, leads_a_session: bool) -> list[str]:
    """Niceness of a process in the background, and of its session."""
    made = subprocess.run(
        [sys.executable, "-c", _SAYS], cwd=REPOSITORY, start_new_session=leads_a_session, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return made.stdout.split()


def test_a_session_of_its_own_is_lowered_with_the_process() -> None:
    lowered = None if of_the_session() is None else 10
    assert said(leads_a_session=True) == [str(min(19, os.nice(0) + 10)), str(lowered)]


def test_the_session_of_other_programs_is_left_alone() -> None:
    assert said(leads_a_session=False) == [str(min(19, os.nice(0) + 10)), str(of_the_session())]
