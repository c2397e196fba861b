"""A call in a child process, with limits that damaged input cannot pass."""

from __future__ import annotations

import importlib
import multiprocessing
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from math import ceil
from typing import TypeVar

import psutil

from service.logs import show_own_words_only

_Result = TypeVar("_Result")


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
