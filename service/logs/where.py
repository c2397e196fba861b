"""What this process works on now (run, step, viewpoint), added to every log line whichever thread writes it.

It belongs to the process, not to a thread: one process drives one run or computes one job, and its drivers answer in
threads of their own.
"""

from __future__ import annotations

from collections.abc import Mapping

_now: Mapping[str, str] = {}


def at(**names: str) -> None:
    """Set names for all later lines, as in `at(step="capture", viewpoint="v1_003")`; "" removes a name."""
    global _now  # noqa: PLW0603 - one per process (see above); replaced as a whole, so no thread sees half of it
    _now = {name: value for name, value in {**_now, **names}.items() if value}


def where_now() -> Mapping[str, str]:
    """The names that are set now."""
    return _now
