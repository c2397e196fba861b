"""Makes this process compute in the background, behind those that drive devices."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_NICE = 10
_SESSION = Path("/proc/self/autogroup")


def compute_in_background() -> None:
    """Lower the priority of this process and of all that it starts.

    With autogroup scheduling, which is usual on desktop Linux, sessions get equal shares of the processor, and
    niceness counts only within one (man 7 sched). A process that leads a session therefore lowers its session too.
    No effect on systems without niceness.
    """
    if not hasattr(os, "nice"):
        return
    os.nice(_NICE)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # this system has no such groups
            _SESSION.write_text(str(_NICE), encoding="ascii")
