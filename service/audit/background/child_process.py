"""Work for a run in a child process: this process follows its progress and its result.

The child writes each change as a line of JSON (`report`), and the parent keeps the last one.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from threading import Lock, Thread
from typing import Any

from service.core.errors import OrthocaptureError
from service.store.durable_effects import Clock, utc_text

Progress = Callable[[str, int, int], None]  # activity, amount done, total
_BETWEEN_REPORTS_S = 0.2
STOPPED = 128 + signal.SIGTERM  # exit status of a child that was stopped and has cleared up


@dataclass(frozen=True, slots=True)
class ChildState:
    """The state of the running child process, or the result of the last one."""

    by: str  # who asked for it
    since_utc: str
    what: str = "starting"
    done: int = 0
    total: int = 0
    problem: str = ""  # why there is no result
    remedy: str = ""
    stopped: bool = False  # by a person
    result: Any = None  # plain data, once there is one

    @property
    def pending(self) -> bool:
        """Whether it is still running."""
        return not self.problem and self.result is None


class ChildProcesses:
    """Runs one module in child processes, at most one at a time for each run."""

    def __init__(self, module: str, name: str, clock: Clock) -> None:
        """Args: `name`: what the module makes, for messages, such as "export"."""
        self._module = module
        self._name = name
        self._clock = clock
        self._states: dict[str, ChildState] = {}
        self._threads: dict[str, Thread] = {}
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._lock = Lock()

    def state(self, run_id: str) -> ChildState | None:
        """The state of the running child, or of the last one; None before the first."""
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
            arguments: of the module's command line.
            by: who asked for it.
            keep: called with the result before it is shown; may raise OSError or ValueError.
            tidy: called when the child has ended, however that was: one that is killed removes nothing itself.
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
    """In a child process, turn SIGTERM into an exception, so that unfinished files are removed on the way out."""
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
