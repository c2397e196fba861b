"""The one seam of what is parallel inside a job: a map over an executor; and calls in a child process with limits."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import resource
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from math import ceil
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar

import psutil

from service.logs import show_own_words_only
from service.machine.resources import processor_model

if TYPE_CHECKING:
    from service.machine.schedulers import Scheduler

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_P = ParamSpec("_P")

VARIABLE = "ORTHOCAPTURE_SCHEDULER"  # the environment variable with the address of a scheduler
IN_THIS_PROCESS = 0  # a number of processes: the work is not worth others, whichever executor was chosen


class MapFunction(Protocol):
    """`map`, in this process or over several."""

    def __call__(self, work: Callable[[_Item], _Result], items: Iterable[_Item], /) -> Iterable[_Result]:
        """Return the results of `work` on the items, in their order."""
        ...


class Executors(Protocol):
    """Opens the executors that compute what is parallel inside a job."""

    def open(self, processes: int, items: int) -> AbstractContextManager[Executor]:
        """Open an executor for some work.

        Args:
            processes: the number of processes that this machine can give; IN_THIS_PROCESS: none besides this one.
            items: the number of items, which compute independently.
        """
        ...


class InThisProcess(Executor):
    """Computes each call in this process: a map when its next result is asked for, a submitted call at once."""

    def submit(self, fn: Callable[_P, _Result], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_Result]:
        """Call the function and return its result or exception as a future."""
        future: Future[_Result] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - a future holds whatever its call raises
            future.set_exception(error)
        return future

    def map(
        self,
        fn: Callable[..., _Result],
        *iterables: Iterable[Any],
        timeout: float | None = None,
        chunksize: int = 1,
    ) -> Iterator[_Result]:
        """Return the results in order; nothing is computed ahead. `timeout` and `chunksize` have no effect."""
        return map(fn, *iterables)


class LocalProcesses:
    """Opens pools of processes on this machine, with a thread of OpenCV each; this process alone for one."""

    def open(self, processes: int, items: int) -> AbstractContextManager[Executor]:
        """Open a pool of at most so many processes."""
        if processes <= 1 or items <= 1:
            return nullcontext(InThisProcess())
        return local_pool(min(processes, items))


def local_pool(processes: int) -> ProcessPoolExecutor:
    """Return a pool of processes on this machine, with a thread of OpenCV each."""
    # Forking a process with threads may deadlock.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(processes, mp_context=context, initializer=_one_thread)


def _one_thread() -> None:
    threading.Thread(target=_end_with_parent, name="parent-watch", daemon=True).start()
    show_own_words_only()
    importlib.import_module("cv2").setNumThreads(1)


def _end_with_parent() -> None:
    """End this process as soon as its parent has died: it would wait for ever for the next task."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


_chosen: ContextVar[Executors] = ContextVar("_chosen", default=LocalProcesses())  # noqa: B039 - it has no state


@contextmanager
def computing_on(executors: Executors) -> Generator[None]:
    """Choose the executors of every map that this block opens; without one, these are local processes."""
    before = _chosen.set(executors)
    try:
        yield
    finally:
        _chosen.reset(before)


@contextmanager
def computing_at(scheduler: Scheduler | None) -> Generator[None]:
    """Choose the executors of a scheduler's cluster for the maps of this block; None: the local ones."""
    if scheduler is None:
        yield
        return
    from service.machine.schedulers import RemoteExecutors  # noqa: PLC0415 - few programs have a cluster

    executors = RemoteExecutors(scheduler)
    try:
        with computing_on(executors):
            yield
    finally:
        executors.close()


@contextmanager
def computing_as_environment_says() -> Generator[None]:
    """Choose the executors of the scheduler that the environment names, for a program without options for it.

    Raises ConfigurationError: what it says is no scheduler.
    """
    address = os.environ.get(VARIABLE, "")
    if not address:
        yield
        return
    from service.machine.schedulers import Scheduler  # noqa: PLC0415 - few programs have a cluster

    ca, cert, key = (
        Path(file) if (file := os.environ.get(f"{VARIABLE}_{name}")) else None for name in ("CA", "CERT", "KEY")
    )
    with computing_at(Scheduler(address, ca, cert, key)):
        yield


@contextmanager
def mapping(processes: int, items: int) -> Generator[MapFunction]:
    """Provide a map over the chosen executor: that of local processes has at most so many, none for one.

    The functions and items of a map hold paths and small parameters, no large arrays: they travel to other machines.
    So do files that these do not see; those that a task reads without having their paths in its item it finds by
    `file_here`, and its item has them in a field of its own. A folder in an item is one that the task writes into: a
    machine that does not see it has an empty one.
    """
    with _chosen.get().open(processes, items) as executor:
        yield executor.map


_found_at: ContextVar[Mapping[str, Path] | None] = ContextVar("_found_at", default=None)


@contextmanager
def finding_files_at(files: Mapping[str, Path]) -> Generator[None]:
    """Let `file_here` find files, by their paths on the job's machine, in this block."""
    before = _found_at.set(files)
    try:
        yield
    finally:
        _found_at.reset(before)


def file_here(path: Path) -> Path:
    """Return the path at which this machine has a file of the task that it computes: mostly the same."""
    return (_found_at.get() or {}).get(str(path.absolute()), path)


def report_each(
    results: Iterable[_Result], total: int, progress: Callable[[int, int], None] | None
) -> Iterator[_Result]:
    """Yield the results, and report after each how many of all there are; `progress` None reports nothing."""
    for done, result in enumerate(results, 1):
        yield result
        if progress is not None:
            progress(done, total)


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """The host on which a task was computed, and the model of its processor: equal bits need equal models."""

    host: str
    processor: str


def this_place() -> Place:
    """Return the place of this process."""
    return Place(socket.gethostname(), processor_model())


_noted: ContextVar[Counter[Place] | None] = ContextVar("_noted", default=None)


@contextmanager
def noting_places() -> Generator[Counter[Place]]:
    """Provide a count of the tasks that other machines compute for the maps of this block; empty if none does."""
    places: Counter[Place] = Counter()
    before = _noted.set(places)
    try:
        yield places
    finally:
        _noted.reset(before)


def noted_places() -> Counter[Place]:
    """Return the count of the block around; one that nobody reads if there is none."""
    return noted if (noted := _noted.get()) is not None else Counter()


@dataclass(frozen=True, slots=True)
class ChildLimits:
    """Limits what a child may take, besides what it has when its modules are imported.

    Attributes:
        memory_bytes: the memory.
        processor_s: the processor time.
    """

    memory_bytes: int
    processor_s: float


class ChildEndedError(Exception):
    """The child was ended: it crashed, or reached its limit of processor time."""


def call_in_child(work: Callable[..., _Result], *arguments: object, module: str, limits: ChildLimits) -> _Result:
    """Return what `work` returns in a process of its own, which imports `module` first.

    Raises:
        ChildEndedError: the child crashed or took too long.
        MemoryError: it wanted more memory than its limit.
    """
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(1, mp_context=context, initializer=_limited, initargs=(module, limits)) as pool:
            return pool.submit(work, *arguments).result()
    except BrokenProcessPool as error:
        raise ChildEndedError from error


def _limited(module: str, limits: ChildLimits) -> None:
    show_own_words_only()
    importlib.import_module(module)
    _lower(resource.RLIMIT_AS, psutil.Process().memory_info().vms + limits.memory_bytes)
    _lower(resource.RLIMIT_CPU, ceil(time.process_time() + limits.processor_s))


def _lower(what: int, limit: int) -> None:
    _, most = resource.getrlimit(what)
    resource.setrlimit(what, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))
