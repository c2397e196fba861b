"""How often the processes of the tests look for garbage."""

from __future__ import annotations

import gc

_THRESHOLDS = (10_000, 20, 20)


def look_for_garbage_rarely() -> None:
    """Look for garbage less often than Python does by itself, which takes a 30th of the time of the tests."""
    gc.set_threshold(*_THRESHOLDS)
