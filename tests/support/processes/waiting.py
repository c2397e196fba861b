"""Waiting for the effect of another process."""

from __future__ import annotations

import time
from collections.abc import Callable


def until(
    condition: Callable[[], bool], what: Callable[[], str] | str, within_s: float = 90.0, *, every_s: float = 0.1
) -> None:
    """Return as soon as the condition holds; fail with `what` if it does not in time, which only a hang reaches."""
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, what if isinstance(what, str) else what()
        time.sleep(every_s)
