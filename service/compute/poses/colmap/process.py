"""A child process for COLMAP, which takes over signal handlers and may crash without affecting ours."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import tempfile
import time
import weakref
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from service.compute.memory import keep_freed_memory
from service.compute.poses.sfm.options import Progress
from service.core.errors import ComputeError, OrthocaptureError


def _child(log: str, seed: int, pipe: Connection) -> None:
    keep_freed_memory()
    importlib.import_module("service.compute.poses.sfm.child").main(log, seed, pipe)


class ColmapProcess:
    """Runs tasks one after another in a child process, which starts with the first task and lives until `close`.

    Not thread-safe.
    """

    def __init__(self, *, seed: int, log: Path | None = None) -> None:
        """Write COLMAP's output to `log`; None: to a temporary file."""
        self._seed = seed
        self._temporary = log is None
        self._log = log
        self._process: Any = None
        self._pipe: Connection | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    def run(self, task: str, job: dict[str, Any], *, timeout_s: float, progress: Progress | None = None) -> Any:
        """Run `task` (see poses.sfm.child) on the job and return its result.

        Raises:
            ComputeError: COLMAP failed, crashed or took too long.
            OrthocaptureError: raised by the task itself.
        """
        try:
            answer = self._answer(task, job, time.monotonic() + timeout_s, progress)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            tail = self._tail()
            self.close()
            raise ComputeError(
                f"COLMAP crashed during {task}: {tail}", where=str(self._log), remedy="See its log"
            ) from None
        except BaseException:
            self.close()  # otherwise a late answer could be taken for the next task's
            raise
        if answer is None:
            self.close()
            raise ComputeError(f"COLMAP did not end {task} within {timeout_s:.0f} s", where=str(self._log))
        kind, value = answer
        if kind == "result":
            return value
        if isinstance(value, OrthocaptureError):
            raise value
        raise ComputeError(f"COLMAP failed during {task}: {value}", where=str(self._log), remedy="See its log")

    def _answer(
        self, task: str, job: dict[str, Any], deadline: float, progress: Progress | None
    ) -> tuple[str, Any] | None:
        """The child's answer to the task; None if it took too long."""
        pipe = self._started()
        pipe.send((task, job))
        while pipe.poll(max(0.0, deadline - time.monotonic())):
            kind, value = pipe.recv()
            if kind != "progress":
                return kind, value
            if progress is not None:
                progress(*value)
        return None

    def close(self) -> None:
        """End the child; the next task starts a new one."""
        if self._process is None:
            return
        assert self._pipe is not None
        self._pipe.close()
        self._process.join(timeout=1)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()
        self._process = self._pipe = None
        if self._temporary and self._log is not None:
            self._log.unlink(missing_ok=True)
            self._log = None

    def _started(self) -> Connection:
        if self._pipe is None:
            if self._log is None:
                handle, name = tempfile.mkstemp(prefix="orthocapture-colmap-", suffix=".log")
                os.close(handle)
                self._log = Path(name)
                weakref.finalize(self, self._log.unlink, missing_ok=True)  # in case nobody closes it
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(
                target=_child, args=(str(self._log), self._seed, theirs), daemon=True, name="colmap"
            )
            self._process.start()
            theirs.close()
        return self._pipe

    def _tail(self) -> str:
        assert self._log is not None
        try:
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except FileNotFoundError:
            return "no log"
        return " | ".join(lines[-3:]) if lines else "empty log"
