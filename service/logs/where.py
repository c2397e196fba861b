"""What this process works on now (run, step, viewpoint): every line of its log says it, whichever thread writes it.

One process drives one run or computes one job, and its drivers answer in threads of their own, which is why this
belongs to the process and not to a thread.
"""

from __future__ import annotations

from collections.abc import Mapping

_now: Mapping[str, str] = {}


def at(**names: str) -> None:
    """From here on: `at(step="capture", viewpoint="v1_003")`; "" takes a name away."""
    global _now  # noqa: PLW0603 - see above; replaced as a whole, so that no thread sees half of it
    _now = {name: value for name, value in {**_now, **names}.items() if value}


def where_now() -> Mapping[str, str]:
    """What was said last."""
    return _now
