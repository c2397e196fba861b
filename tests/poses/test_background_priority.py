"""Background computations let the processes of a capture go first, also where sessions get equal shares."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.support.rig.rig import REPOSITORY

_SAYS = (
    "import os; from service.machine.resources import compute_in_background; "
    "from tests.poses.test_background_priority import of_the_session; "
    "before = of_the_session(); compute_in_background();"
    " print(before, os.nice(0), of_the_session())"
)


def of_the_session() -> int | None:
    """Niceness of this process' session; None where sessions are not scheduled as groups (an empty file)."""
    group = Path("/proc/self/autogroup")
    words = group.read_text(encoding="ascii").split() if group.exists() else []
    return int(words[-1]) if words else None


def said(*, leads_a_session: bool) -> list[str]:
    """Niceness of the session before, of a process in the background, and of the session then.

    A new session can be a group of its own where that of the tests is none, and the other way round, so what it was
    before is read in the process itself.
    """
    made = subprocess.run(
        [sys.executable, "-c", _SAYS], cwd=REPOSITORY, start_new_session=leads_a_session, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return made.stdout.split()


def test_a_session_of_its_own_is_lowered_with_the_process() -> None:
    before, process, session = said(leads_a_session=True)
    assert process == str(min(19, os.nice(0) + 10))
    assert session == ("None" if before == "None" else "10")


def test_the_session_of_other_programs_is_left_alone() -> None:
    before, process, session = said(leads_a_session=False)
    assert process == str(min(19, os.nice(0) + 10))
    assert session == before
