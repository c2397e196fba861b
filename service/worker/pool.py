"""A worker that does as many jobs at once as there are cores, each in a child process of its own.

A child that dies loses its job to the next one, as the death of a whole worker does, and is replaced. What a step
waits for has children of its own, so that it never waits behind a computation of many minutes that nobody waits for.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

from service.compute.memory import keep_freed_memory
from service.core.jobs.priorities import Lane
from service.logs.file_log import file_log
from service.monitor.worker_sign import SignOfLife
from service.store.store import Store
from service.worker.loop import work

_log = logging.getLogger(__name__)
_POLL_S = 0.2
_RESTART_S = 1.0  # before a child that died is replaced
_MOST_WAITED = 4  # children for what is waited for: there are seldom more such jobs at once
_NICE = 10  # of the children for what is not: the others, and the capture, come first

Progress = Callable[[str, int, int], None]


@dataclass
class _Child:
    process: SpawnProcess
    pipe: Connection
    lane: Lane
    scratch: Path
    died_s: float | None = None
    busy: bool = False  # it has begun a job and has not said that it ended


class Pool:
    """The children of one worker. Use it in a `with`: at its end they stop and their jobs are queued again."""

    def __init__(self, store: Store, data: Path, at_once: int) -> None:
        self.done = 0
        self._store, self._data = store, data
        self._scratch = tempfile.TemporaryDirectory(prefix="orthocapture-worker-", ignore_cleanup_errors=True)
        self._context = multiprocessing.get_context("spawn")
        self._most: dict[Lane, int] = {"waited": min(at_once, _MOST_WAITED), "background": at_once}
        self._children = [self._start("waited")]  # the others when there is work for them

    def tend(self, progress: Progress, timeout_s: float = _POLL_S) -> bool:
        """Hear what the children say, up to `timeout_s`; replace those that have died, and start what is needed.

        Whether any of them had something to say.
        """
        by_pipe = {child.pipe: child for child in self._children if child.died_s is None}
        heard = wait(list(by_pipe), timeout_s)
        for ready in heard:
            assert isinstance(ready, Connection)
            with contextlib.suppress(EOFError, OSError):  # it has died, which is seen below
                what, done, total = ready.recv()
                by_pipe[ready].busy = total >= 0
                if total < 0:
                    self.done += 1
                else:
                    progress(what, done, total)
        for index, child in enumerate(self._children):
            if child.died_s is None and not child.process.is_alive():
                child.died_s = time.monotonic()
                _log.warning("process %s of the worker died; its job is done again", child.process.pid)
            if child.died_s is not None and time.monotonic() - child.died_s > _RESTART_S:
                self._end(child)
                self._children[index] = self._start(child.lane)
        for lane, most in self._most.items():
            there = sum(child.lane == lane for child in self._children)
            if there < min(most, self._store.open_jobs(lane=lane)):
                self._children.append(self._start(lane))
        if not by_pipe:
            time.sleep(timeout_s)
        return bool(heard)

    @property
    def busy(self) -> bool:
        """Whether a living child has begun a job and has not said that it ended."""
        return any(child.busy and child.died_s is None for child in self._children)

    def pids(self) -> list[int]:
        """The children's processes, in the order in which they were started."""
        return [child.process.pid or 0 for child in self._children]

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_exc: object) -> None:
        pids = self.pids()
        for child in self._children:
            self._end(child)
        self._store.release_jobs(pids)
        self._scratch.cleanup()

    def _start(self, lane: Lane) -> _Child:
        ours, theirs = self._context.Pipe(duplex=False)
        scratch = Path(tempfile.mkdtemp(dir=self._scratch.name))
        arguments = (self._data, lane, scratch, theirs, os.getpid())
        process = self._context.Process(target=_serve, args=arguments, name=f"orthocapture-{lane}")
        process.start()
        theirs.close()
        return _Child(process, ours, lane, scratch)

    def _end(self, child: _Child) -> None:
        child.process.kill()
        child.process.join()
        _kill(child.process.pid or 0)
        child.process.close()
        child.pipe.close()
        shutil.rmtree(child.scratch, ignore_errors=True)


def _kill(group: int) -> None:
    """End a child and all that it has started: a child leads a process group of its own."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def work_side_by_side(
    data: Path, *, at_once: int, until_idle: bool, stop: Callable[[], bool], progress: Progress
) -> int:
    """Serve the jobs of a data folder until `stop()`, or with `until_idle` until none is open; how many were done.

    Args:
        data: the data folder.
        at_once: jobs that nobody waits for, computed side by side; up to as many more that a step waits for.
        until_idle: see above.
        stop: asked several times a second.
        progress: told what is computed, how much of it is done, and all of it.
    """
    with Store.open(data) as store:
        if until_idle and not store.open_jobs():
            return 0
        with Pool(store, data, at_once) as pool, contextlib.closing(SignOfLife(data)) as sign:
            while not stop():
                pool.tend(progress)
                sign.give(pool.done)
                if until_idle and not store.open_jobs():
                    while pool.tend(progress) or pool.busy:  # a job's end is in the store before its child says so
                        pass
                    break
            return pool.done


# --- in a child ---------------------------------------------------------------------------------------------------


def _serve(data: Path, lane: Lane, scratch: Path, pipe: Connection, parent: int) -> None:
    """Entry point of a child."""
    os.setsid()  # Ctrl-C is for the worker, which ends its children and what they have started
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    tempfile.tempdir = str(scratch)
    keep_freed_memory()
    if lane == "background" and hasattr(os, "nice"):
        os.nice(_NICE)

    def tell(what: str, done: int, total: int) -> None:
        with contextlib.suppress(OSError):  # the worker has gone, and this process goes too
            pipe.send((what, done, total))

    with file_log(data, "worker"), Store.open(data) as store:
        work(store, until_idle=False, stop=lambda: False, progress=tell, lane=lane, finished=lambda: tell("", 0, -1))


def _end_with(parent: int) -> None:
    """A child whose worker was killed computes for nobody: it ends at once, with all that it has started."""
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    _kill(os.getpid())
