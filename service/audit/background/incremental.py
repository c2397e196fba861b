"""Values that take longer to compute than a request may: computed in the background, kept in memory, and updated."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from dataclasses import dataclass, field
from threading import Lock
from typing import Generic, Protocol, Self, TypeVar

from sqlalchemy import text

from service.audit.record.run_rows import head
from service.store.store import Store

WAIT_S = 0.08  # how long a page waits before it says "being computed"
_LARGE = 2000  # events; the first computation of a larger run is not waited for
_GRACE_S = 0.25  # before a long computation begins, so that the page that asked is answered first
_REST_S = 0.001  # pause between two chunks, so that pages come first


class CopyableResult(Protocol):
    """A value that can be computed step by step."""

    def copy(self) -> Self:
        """A copy that can be continued while pages read this one."""
        ...


T = TypeVar("T", bound=CopyableResult)


@dataclass(frozen=True, slots=True)
class PartialResult(Generic[T]):
    """A result after one more chunk of events."""

    value: T
    seq: int  # the last event that it covers
    last: int  # of the run
    sha256: str  # of that event


@dataclass(frozen=True, slots=True)
class Progress:
    """The progress of a computation."""

    done: int
    total: int


@dataclass(slots=True)
class _Entry(Generic[T]):
    lock: Lock = field(default_factory=Lock)
    step: PartialResult[T] | None = None
    future: Future[None] | None = None
    somebody_waits: bool = False


class IncrementalResults(Generic[T]):
    """One value for each run, computed in chunks by `advance(run_id, value so far or None)`.

    Nothing is cached on disk, so every value on a page was read from the evidence by this process.
    """

    def __init__(self, store: Store, advance: Callable[[str, T | None], PartialResult[T]], name: str) -> None:
        self._store = store
        self._advance = advance
        self._asked = ThreadPoolExecutor(max_workers=2, thread_name_prefix=f"{name}-asked")
        self._ahead = ThreadPoolExecutor(max_workers=1, thread_name_prefix=f"{name}-ahead")
        self._entries: dict[str, _Entry[T]] = {}
        self._lock = Lock()
        self._warm = False

    def get(self, run_id: str, wait_s: float = WAIT_S) -> T | Progress:
        """The value for the present events of a run, or its progress. Raises UnknownRunError, errors of `advance`."""
        ready = self.ready(run_id)
        if not isinstance(ready, Progress):
            return ready
        # The first computation in a process also imports its modules, which takes a second.
        long = ready.total - ready.done > _LARGE or not self._warm
        future = self._submit(run_id, somebody_waits=True, grace_s=_GRACE_S if long and wait_s <= WAIT_S else 0.0)
        with suppress(FutureTimeoutError):
            future.result(0 if long and wait_s <= WAIT_S else wait_s)
        return self.ready(run_id)

    def ready(self, run_id: str) -> T | Progress:
        """The value if it is up to date, else None; nothing is computed. Raises UnknownRunError."""
        with self._store.database.reading() as connection:
            last, sha256 = head(connection, run_id)
        return self.at(run_id, last, sha256)

    def at(self, run_id: str, last: int, sha256: str) -> T | Progress:
        """`ready` for a known end of the chain."""
        entry = self._entry(run_id)
        step = entry.step
        if step is None:
            return Progress(0, last)
        # The hash as well, because the folder may have been replaced by an earlier copy of it.
        return step.value if (step.seq, step.sha256) == (last, sha256) else Progress(min(step.seq, last), last)

    def warm(self, run_id: str) -> None:
        """Compute the value in the background, after those that a page is waiting for."""
        self._submit(run_id, somebody_waits=False)

    def close(self) -> None:
        """Stop the threads."""
        for executor in (self._asked, self._ahead):
            executor.shutdown(wait=True, cancel_futures=True)

    def _entry(self, run_id: str) -> _Entry[T]:
        with self._lock:
            return self._entries.setdefault(run_id, _Entry())

    def _submit(self, run_id: str, *, somebody_waits: bool, grace_s: float = _GRACE_S) -> Future[None]:
        entry = self._entry(run_id)
        with self._lock:
            future = entry.future
            under_way = future is not None and not future.done()
            if future is None or not under_way or (somebody_waits and not entry.somebody_waits):
                executor = self._asked if somebody_waits else self._ahead
                entry.future = future = executor.submit(self._compute, run_id, entry, grace_s)
                entry.somebody_waits = somebody_waits
            return future

    def _compute(self, run_id: str, entry: _Entry[T], grace_s: float) -> None:
        if not self._warm:
            time.sleep(grace_s)
        with entry.lock:
            if entry.step is not None and not self._still_holds(run_id, entry.step):
                entry.step = None
            with self._store.database.reading() as connection:
                last, _ = head(connection, run_id)
            value = entry.step.value.copy() if entry.step is not None else None
            while entry.step is None or entry.step.seq < max(last, entry.step.last):
                entry.step = self._advance(run_id, value)
                value = entry.step.value
                self._warm = True
                time.sleep(_REST_S)

    def _still_holds(self, run_id: str, step: PartialResult[T]) -> bool:
        if step.seq < step.last:
            return False  # was interrupted
        with self._store.database.reading() as connection:
            rows = connection.execute(
                text("SELECT sha256 FROM events WHERE run_id = :run AND seq = :seq"), {"run": run_id, "seq": step.seq}
            )
            return rows.scalar_one_or_none() == step.sha256
