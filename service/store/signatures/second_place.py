"""The second place of signatures: copies that are kept elsewhere, by a thread that nothing waits for for long.

A place can be away: the folder cannot be reached, is full or read-only, or hangs as a share does whose server is
gone. That is told and tried again, and stops nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Protocol, Self

from service.core.errors import StoreError
from service.core.text.words import time_here
from service.store.durable_effects import Clock, Files, Signal, utc_text
from service.store.journal.copies import JournalCopy, journal_copy
from service.store.signatures.log import NAME
from service.store.signatures.log_copy import LogCopy

AGAIN_S = 30.0  # until a place that may be away is tried again where nothing is signed
_PATIENCE_S = 3.0  # a share that answers needs milliseconds


@dataclass(frozen=True, slots=True)
class Away:
    """Since when the second place is not up to date, and why."""

    place: Path
    since_utc: str
    why: str


class KeptCopy(Protocol):
    """A copy that is kept in the second place."""

    @property
    def copy(self) -> Path:
        """The file there."""
        ...

    def bring_up_to_date(self) -> None:
        """Write there what is missing. Raises StoreError; the next call will add what is missing."""
        ...


class SecondPlace:
    """The copies of one data folder. Without `copies`, none is kept, and nothing is ever away."""

    def __init__(self, copies: Sequence[KeptCopy], clock: Clock, *, patience_s: float = _PATIENCE_S) -> None:
        self._copies = tuple(copies)
        self._clock = clock
        self._patience_s = patience_s
        self._lock = Lock()
        self._away: Away | None = None
        self._busy = False
        self._again = False  # asked for while the thread was busy

    @classmethod
    def of(
        cls, data_dir: Path, copy: Path | None, clock: Clock, files: Files, *, patience_s: float = _PATIENCE_S
    ) -> Self:
        """That of a data folder whose log of signatures is copied to `copy`, and its journal to a file beside it.

        `copy` is None if it has no second place.
        """
        if copy is None:
            return cls((), clock, patience_s=patience_s)
        kept = LogCopy(data_dir / NAME, copy, files), JournalCopy(data_dir, journal_copy(copy), files)
        return cls(kept, clock, patience_s=patience_s)

    @property
    def away(self) -> Away | None:
        """Since when the place is away; None if it is up to date, as far as is known."""
        return self._away

    def update(self) -> Away | None:
        """Write there what is missing, and wait for it a little. Returns what is known then; raises nothing."""
        if not self._copies:
            return None
        with self._lock:
            if self._busy:
                self._again = True
                return self._away
            self._busy, self._again = True, False
        done = Event()  # by the host's clock: a file knows no other
        Thread(target=self._work, args=(done,), name="second place", daemon=True).start()
        if not done.wait(self._patience_s):
            with self._lock:
                if self._busy and not done.is_set():
                    self._tell(self._copies[0].copy, f"it has not answered for {self._patience_s:g} s")
        return self._away

    def look_after(self, ended: Signal) -> None:
        """Try again now and then until `ended` is set: the place may come back, or go away, while nobody signs."""
        while not ended.wait(AGAIN_S):
            self.update()

    def _work(self, done: Event) -> None:
        while True:
            failed = self._written()
            with self._lock:
                if failed is None:
                    self._away = None
                else:
                    self._tell(*failed)
                if not self._again:
                    self._busy = False
                    break
                self._again = False
        done.set()

    def _written(self) -> tuple[Path, str] | None:
        """Bring every copy up to date; else which one failed, and why."""
        for one in self._copies:
            try:
                one.bring_up_to_date()
            except StoreError as error:
                return one.copy, error.what
            except (OSError, ValueError) as error:  # a path that no file can have
                return one.copy, str(error)
        return None

    def _tell(self, place: Path, why: str) -> None:
        since_utc = self._away.since_utc if self._away is not None else utc_text(self._clock.utc_now())
        self._away = Away(place, since_utc, why)


def away_words(away: Away) -> str:
    """What is told of a second place that is away."""
    since = time_here(away.since_utc)
    return (
        f"the second place of the signatures, {away.place}, has not been up to date since {since}: {away.why}. "
        "It is tried again by itself, and what is missing will be written there"
    )
