"""Work in child processes: a map over several, and a call with limits that damaged input cannot pass."""

from __future__ import annotations

import importlib
import multiprocessing
import resource
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from typing import Protocol, TypeVar

import psutil

from service.logs.terminal import show_own_words_only

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class MapFunction(Protocol):
    """`map`, in this process or over several."""

    def __call__(self, work: Callable[[_Item], _Result], items: Iterable[_Item], /) -> Iterable[_Result]:
        """Return the results of `work` on the items, in their order."""
        ...


@contextmanager
def mapping(workers: int, items: int) -> Generator[MapFunction]:
    """Provide a map over at most so many processes, with a thread of OpenCV each; the plain one for one worker."""
    if workers <= 1 or items <= 1:
        yield map
        return
    # Forking a process with threads may deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, items), mp_context=context, initializer=_one_thread) as pool:
        yield pool.map


def report_each(
    results: Iterable[_Result], total: int, progress: Callable[[int, int], None] | None
) -> Iterator[_Result]:
    """Yield the results, and report after each how many of all there are; `progress` None reports nothing."""
    for done, result in enumerate(results, 1):
        yield result
        if progress is not None:
            progress(done, total)


def _one_thread() -> None:
    show_own_words_only()
    importlib.import_module("cv2").setNumThreads(1)


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
