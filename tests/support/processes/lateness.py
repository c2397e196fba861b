"""How late this machine lets threads wake: the reference for tests that meet the clock."""

from __future__ import annotations

import statistics
import threading
import time

_NAP_S = 0.005


class Lateness:
    """Measures while its block runs, with a thread that sleeps again and again."""

    def __init__(self) -> None:
        self._late_s = [0.0]
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Lateness:
        self._thread.start()
        return self

    def __exit__(self, *_exc: object) -> None:
        self._over.set()
        self._thread.join()

    @property
    def worst_s(self) -> float:
        """By how much the latest nap was too long."""
        return max(self._late_s)

    @property
    def usual_s(self) -> float:
        """By how much half of the naps were too long."""
        return statistics.median(self._late_s)

    def _run(self) -> None:
        while not self._over.is_set():
            before_s = time.monotonic()
            time.sleep(_NAP_S)
            self._late_s.append(max(0.0, time.monotonic() - before_s - _NAP_S))
