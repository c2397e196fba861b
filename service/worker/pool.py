"""A worker that computes as many jobs in parallel as there are cores, each in a child process; and its uploader.

A child that dies is replaced, and its job is computed by another one. Jobs that a step waits for have their own
children, so that they never queue behind long background computations.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.errors import ConfigurationError
from service.core.run.state import Lane
from service.logs import file_log, show_own_words_only
from service.machine.executors import computing_at
from service.machine.resources import compute_in_background, keep_freed_memory
from service.monitor.snapshot import SignOfLife
from service.store.data_folder import object_store_of
from service.store.store import Store
from service.worker.loop import Abilities, work

if TYPE_CHECKING:
    from service.machine.schedulers import Scheduler

_log = logging.getLogger(__name__)
_POLL_S = 0.2
_RESTART_S = 1.0  # delay before a dead child is replaced
_MOST_WAITED = 4  # children for jobs that a step waits for; there are seldom more of them at a time

Progress = Callable[[str, int, int], None]


@dataclass
class _Child:
    process: SpawnProcess
    pipe: Connection
    lane: Lane
    scratch: Path
    died_s: float | None = None
    busy: bool = False  # it has started a job and not reported its end
    ended: bool = False  # it has ended itself, with a job that was cancelled or took too long


class Pool:
    """The children of one worker, as a context manager: at its end they are stopped and their jobs queued again."""

    def __init__(
        self,
        store: Store,
        data: Path,
        at_once: int,
        scheduler: Scheduler | None = None,
        kinds: tuple[str, ...] | None = None,
    ) -> None:
        self.done = 0
        self._scheduler, self._kinds = scheduler, kinds
        self._store, self._data = store, data
        self._scratch = tempfile.TemporaryDirectory(prefix="orthocapture-worker-", ignore_cleanup_errors=True)
        self._context = multiprocessing.get_context("spawn")
        self._most: dict[Lane, int] = {"waited": min(at_once, _MOST_WAITED), "background": at_once}
        self._children = [self._start("waited")]  # others are started when needed

    def tend(self, progress: Progress, timeout_s: float = _POLL_S) -> bool:
        """Receive messages of the children for up to `timeout_s`; replace dead children, and start missing ones.

        Returns whether there was a message.
        """
        by_pipe = {child.pipe: child for child in self._children if child.died_s is None}
        heard = wait(list(by_pipe), timeout_s)
        for ready in heard:
            assert isinstance(ready, Connection)
            with contextlib.suppress(EOFError, OSError):  # it has died, which is handled below
                what, done, total = ready.recv()
                by_pipe[ready].busy = total >= 0
                if total < 0:
                    self.done += 1
                    by_pipe[ready].ended = done < 0
                else:
                    progress(what, done, total)
        for index, child in enumerate(self._children):
            if child.died_s is None and not child.process.is_alive():
                child.died_s = self._store.clock.monotonic_s()
                if not child.ended:
                    _log.warning("process %s of the worker died; its job is computed again", child.process.pid)
            if child.died_s is not None and self._store.clock.monotonic_s() - child.died_s > _RESTART_S:
                self._end(child)
                self._children[index] = self._start(child.lane)
        for lane, most in self._most.items():
            there = sum(child.lane == lane for child in self._children)
            if there < min(most, self._store.open_jobs(lane=lane, kinds=self._kinds)):
                self._children.append(self._start(lane))
        if not by_pipe:
            self._store.clock.sleep(timeout_s)
        return bool(heard)

    @property
    def busy(self) -> bool:
        """True if a living child has started a job and not reported its end."""
        return any(child.busy and child.died_s is None for child in self._children)

    def pids(self) -> list[int]:
        """Return the children's process ids, in the order in which they were started."""
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
        arguments = (self._data, lane, scratch, theirs, os.getpid(), self._scheduler, self._kinds)
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
    """Kill a child and all processes that it has started: each child leads its own process group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def work_side_by_side(
    data: Path,
    *,
    at_once: int,
    until_idle: bool,
    stop: Callable[[], bool],
    progress: Progress,
    scheduler: Scheduler | None = None,
    kinds: tuple[str, ...] | None = None,
) -> int:
    """Compute the jobs of a data folder in parallel until `stop()`.

    Args:
        data: the data folder.
        at_once: number of background jobs in parallel; there may be as many again that a step waits for.
        until_idle: true to end when no job is open.
        stop: called several times a second.
        progress: called with what a job does, how much is done, and the total.
        scheduler: that of the cluster which computes what is parallel inside a job; None: this machine does.
        kinds: the kinds of jobs to compute; None: all.

    Returns:
        the number of jobs computed.
    """
    with Store.open(data) as store:
        abilities = Abilities(data, store.clock)

        def idle() -> bool:
            """Say whether no job is left that this machine can compute."""
            return not store.open_jobs(kinds=kinds, able=abilities.able) and not abilities.look()

        if until_idle and idle():
            return 0
        with (
            Pool(store, data, at_once, scheduler, kinds) as pool,
            contextlib.closing(SignOfLife(data, store.clock, kinds or ())) as sign,
        ):
            while not stop():
                pool.tend(progress)
                sign.give(pool.done)
                if until_idle and idle():
                    while pool.tend(progress) or pool.busy:  # a job's end is recorded before its child reports it
                        pass
                    break
            return pool.done


# --- in a child ---------------------------------------------------------------------------------------------------


def _serve(
    data: Path,
    lane: Lane,
    scratch: Path,
    pipe: Connection,
    parent: int,
    scheduler: Scheduler | None,
    kinds: tuple[str, ...] | None,
) -> None:
    """Run a child: its entry point."""
    show_own_words_only()
    os.setsid()  # Ctrl-C must reach only the worker, which ends its children and their processes
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    tempfile.tempdir = str(scratch)
    keep_freed_memory()
    if lane == "background":
        compute_in_background()

    def tell(what: str, done: int, total: int) -> None:
        with contextlib.suppress(OSError):  # the worker has ended, and this process will too
            pipe.send((what, done, total))

    def end() -> None:
        tell("", -1, -1)
        _kill(os.getpid())  # no thread can stop a computation in another one; the worker starts a new child

    with file_log(data, "worker"), Store.open(data) as store, computing_at(scheduler):
        work(
            store,
            until_idle=False,
            stop=lambda: False,
            progress=tell,
            lane=lane,
            kinds=kinds,
            finished=lambda: tell("", 0, -1),
            end=end,
        )


def _end_with(parent: int) -> None:
    """End this child and all its processes as soon as the worker has died."""
    while os.getppid() == parent:
        time.sleep(_POLL_S)
    _kill(os.getpid())


# --- the uploader beside the worker: a process of its own, so that nothing of the network reaches the worker's ----

_UPLOADER_POLL_S = 1.0
_FIRST_WAIT_S, _LONGEST_WAIT_S = 2.0, 60.0
_GRACE_S = 5.0


@contextmanager
def uploading(data: Path) -> Generator[None]:
    """Keep an uploader at work meanwhile, if the data folder's site.yaml names an object store; else nothing begins.

    A site.yaml that is wrong, or a package that is missing, is logged: the worker goes on without it.
    """
    if not _names_store(data):
        yield
        return
    over = threading.Event()
    keeper = threading.Thread(target=_keep, args=(data, over), name="uploader", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        over.set()
        keeper.join()


def _names_store(data: Path) -> bool:
    try:
        section = object_store_of(data)
        if section is None:
            return False
        from service.store.objects.opening import open_objects  # noqa: PLC0415 - for sites only

        open_objects(data, section)
    except ConfigurationError as error:
        _log.error("nothing is uploaded: %s", error)
        return False
    return True


def _keep(data: Path, over: threading.Event) -> None:
    """Start the uploader again whenever it ends, until `over`; then end it."""
    arguments = ["store", "upload", "--follow", "--data", str(data), "--json", "--parent", str(os.getpid())]
    wait_s = _FIRST_WAIT_S
    while not over.is_set():
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "service.cli.main", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:  # for want of memory, say
            _log.warning("no uploader could be started: %s", error.strerror)
            over.wait(wait_s)
            continue
        while process.poll() is None and not over.wait(_UPLOADER_POLL_S):
            pass
        if over.is_set():
            _end(process)
            return
        _log.warning("the uploader has ended (status %s); another one is started", process.returncode)
        over.wait(wait_s)
        wait_s = min(2 * wait_s, _LONGEST_WAIT_S)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:  # it waits for the network
        process.kill()
        process.wait()
