"""Waiting for the effect of another process."""

from __future__ import annotations

import time
from collections.abc import Callable

_AT_FIRST_S, _LONGER = 0.02, 2.0


def until(
    condition: Callable[[], bool], what: Callable[[], str] | str, within_s: float = 90.0, *, every_s: float = 0.1
) -> None:
    """Return as soon as the condition holds; fail with `what` if it does not in time, which only a hang reaches.

    It is looked at more often at first, since most waits are short.
    """
    deadline_s = time.monotonic() + within_s
    rest_s = min(_AT_FIRST_S, every_s)
    while not condition():
        assert time.monotonic() < deadline_s, what if isinstance(what, str) else what()
        time.sleep(rest_s)
        rest_s = min(_LONGER * rest_s, every_s)
