"""Works for pages in the background: in child processes that are followed, or piece by piece in this one.

The child writes each change as a line of JSON (`report`), and the parent keeps the last one.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from dataclasses import dataclass, field, replace
from threading import Lock, Thread
from typing import Any, Generic, Protocol, Self, TypeVar

from sqlalchemy import text

from service.audit.queries import head
from service.core.errors import OrthocaptureError
from service.store.durable_effects import Clock, utc_text
from service.store.store import Store

Progress = Callable[[str, int, int], None]  # activity, amount done, total
_BETWEEN_REPORTS_S = 0.2
STOPPED = 128 + signal.SIGTERM  # exit status of a child that was stopped and has cleared up


@dataclass(frozen=True, slots=True)
class ChildState:
    """The state of the running child process, or the result of the last one."""

    by: str  # account of the person who asked for it
    since_utc: str
    what: str = "starting"
    done: int = 0
    total: int = 0
    problem: str = ""  # why there is no result
    remedy: str = ""
    stopped: bool = False  # true if a person stopped it
    result: Any = None  # plain data, once there is one

    @property
    def pending(self) -> bool:
        """True while the child is still running."""
        return not self.problem and self.result is None


class ChildProcesses:
    """Runs one module in child processes, at most one at a time for each run."""

    def __init__(self, module: str, name: str, clock: Clock) -> None:
        """Run `module`; `name` says in messages what it makes, such as "export"."""
        self._module = module
        self._name = name
        self._clock = clock
        self._states: dict[str, ChildState] = {}
        self._threads: dict[str, Thread] = {}
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._lock = Lock()

    def state(self, run_id: str) -> ChildState | None:
        """Return the state of the running child, or of the last one; None before the first."""
        with self._lock:
            return self._states.get(run_id)

    def start(
        self,
        run_id: str,
        arguments: Sequence[str],
        *,
        by: str,
        keep: Callable[[ChildState], None] | None = None,
        tidy: Callable[[], None] | None = None,
    ) -> bool:
        """Start a child unless one is running for this run. Returns whether it was started.

        Args:
            run_id: the run.
            arguments: the arguments of the module's command line.
            by: the account of the person who asked for it.
            keep: a function that is called with the result before it is shown; may raise OSError or ValueError.
            tidy: a function that is called when the child has ended in any way; a killed one removes nothing itself.
        """
        with self._lock:
            now = self._states.get(run_id)
            if now is not None and now.pending:
                return False
            begun = ChildState(by, utc_text(self._clock.utc_now()))
            self._states[run_id] = begun
            thread = Thread(
                target=self._follow,
                args=(run_id, arguments, begun, keep, tidy),
                name=f"{self._name} {run_id}",
                daemon=True,
            )
            self._threads[run_id] = thread
        thread.start()
        return True

    def stop(self, run_id: str) -> bool:
        """Ask the running child to end (SIGTERM). Returns whether there was one."""
        with self._lock:
            process = self._running.get(run_id)
            if process is None:
                return False
            process.terminate()
            return True

    def wait(self, run_id: str, timeout_s: float) -> None:
        """Wait until the running child has ended."""
        thread = self._threads.get(run_id)
        if thread is not None:
            thread.join(timeout_s)

    def _follow(
        self,
        run_id: str,
        arguments: Sequence[str],
        begun: ChildState,
        keep: Callable[[ChildState], None] | None,
        tidy: Callable[[], None] | None,
    ) -> None:
        try:
            try:
                ended = self._heard(run_id, arguments, begun)
            finally:
                if tidy is not None:
                    tidy()
            if keep is not None and not ended.problem:
                keep(ended)
        except (OSError, ValueError, TypeError) as error:
            ended = replace(begun, problem=f"the {self._name} could not be done: {error}", remedy="Try again")
        self._set(run_id, ended)

    def _heard(self, run_id: str, arguments: Sequence[str], begun: ChildState) -> ChildState:
        """Run the child and listen to it until it has ended. Raises OSError, ValueError, TypeError."""
        ended = replace(begun, problem=f"the {self._name} ended without a result", remedy="Try again")
        command = [sys.executable, "-m", self._module, *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
            assert process.stdout is not None  # a pipe was asked for
            with self._lock:
                self._running[run_id] = process
            try:
                for line in process.stdout:
                    told = replace(begun, **json.loads(line))
                    if told.pending:
                        self._set(run_id, told)
                    else:
                        ended = told
            finally:
                with self._lock:
                    del self._running[run_id]
        if ended.result is None and process.returncode in (STOPPED, -signal.SIGTERM):
            return replace(begun, stopped=True, problem=f"the {self._name} was stopped")
        return ended

    def _set(self, run_id: str, state: ChildState) -> None:
        with self._lock:
            self._states[run_id] = state


def ends_tidily_when_stopped() -> None:
    """Turn SIGTERM into an exception in a child process, so that unfinished files are removed on the way out."""
    signal.signal(signal.SIGTERM, lambda _number, _frame: sys.exit(STOPPED))


def report(work: Callable[[Progress], Any], *, outlives_parent: bool) -> None:
    """Do the work of a child process and write its progress, then its result or its problem, to stdout.

    Args:
        work: a function that takes a progress callback and returns the result as plain data.
        outlives_parent: continue if nobody reads the output any more; otherwise BrokenPipeError is raised.
    """
    last_s = -_BETWEEN_REPORTS_S
    listening = True

    def say(**line: object) -> None:
        nonlocal listening
        if not listening:
            return
        try:
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()
        except BrokenPipeError:  # the parent was restarted
            if not outlives_parent:
                raise
            listening = False

    def progress(what: str, done: int, total: int) -> None:
        nonlocal last_s
        if time.monotonic() - last_s > _BETWEEN_REPORTS_S:
            last_s = time.monotonic()
            say(what=what, done=done, total=total)

    try:
        result = work(progress)
    except OrthocaptureError as error:
        place = f" [{error.where}]" if error.where else ""
        say(problem=f"{error.what}{place}", remedy=error.remedy)
    else:
        say(result=result)


WAIT_S = 0.08  # how long a page waits before it says "being computed"
_LARGE = 2000  # events; the first computation of a larger run is not waited for
_GRACE_S = 0.25  # before a long computation begins, so that the page that asked is answered first
_REST_S = 0.001  # pause between two chunks, so that pages come first


class CopyableResult(Protocol):
    """A value that can be computed step by step."""

    def copy(self) -> Self:
        """Return a copy that can be continued while pages read this one."""
        ...


T = TypeVar("T", bound=CopyableResult)


@dataclass(frozen=True, slots=True)
class PartialResult(Generic[T]):
    """A result after one more chunk of events."""

    value: T
    seq: int  # the last event that it covers
    last: int  # number of the run's last event
    sha256: str  # hash of that event


@dataclass(frozen=True, slots=True)
class PartialProgress:
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

    def get(self, run_id: str, wait_s: float = WAIT_S) -> T | PartialProgress:
        """Return the value for the present events of a run, or its progress.

        Raises UnknownRunError, errors of `advance`.
        """
        ready = self.ready(run_id)
        if not isinstance(ready, PartialProgress):
            return ready
        # The first computation in a process also imports its modules, which takes a second.
        long = ready.total - ready.done > _LARGE or not self._warm
        future = self._submit(run_id, somebody_waits=True, grace_s=_GRACE_S if long and wait_s <= WAIT_S else 0.0)
        with suppress(FutureTimeoutError):
            future.result(0 if long and wait_s <= WAIT_S else wait_s)
        return self.ready(run_id)

    def ready(self, run_id: str) -> T | PartialProgress:
        """Return the value if it is up to date, else None; nothing is computed. Raises UnknownRunError."""
        with self._store.database.reading() as connection:
            last, sha256 = head(connection, run_id)
        return self.at(run_id, last, sha256)

    def at(self, run_id: str, last: int, sha256: str) -> T | PartialProgress:
        """Do as `ready` for a known end of the chain."""
        entry = self._entry(run_id)
        step = entry.step
        if step is None:
            return PartialProgress(0, last)
        # The hash as well, because the folder may have been replaced by an earlier copy of it.
        return step.value if (step.seq, step.sha256) == (last, sha256) else PartialProgress(min(step.seq, last), last)

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
