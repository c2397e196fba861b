"""Governs what this process takes of its machine: memory, how freed memory is held, and its priority."""

from __future__ import annotations

import ctypes
import mmap
import os
import platform
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
import psutil
from numpy.typing import NDArray

from service.core.units import megabytes

IMAGE_MB = 1000.0  # estimated, of a process that looks at one photograph of 60 megapixels after the other
_UNLIMITED = 1 << 60  # what older kernels state where there is no limit is larger


@dataclass(frozen=True, slots=True)
class MachineMemory:
    """All of the memory, and what is free or can be freed at once."""

    total_mb: float
    available_mb: float


def machine_memory(root: Path = Path("/")) -> MachineMemory:
    """Measure the memory that this process and others like it can have; it is less in a container or a group.

    Args:
        root: folder above `proc` and `sys`.
    """
    machine = psutil.virtual_memory()
    total, available = machine.total, machine.available
    for limit, used in _groups(root):
        if limit < min(total, _UNLIMITED):
            total = limit
        available = min(available, max(0, limit - used))
    return MachineMemory(megabytes(total), megabytes(available))


def processes_for(items: int, each_mb: float, memory: MachineMemory | None = None) -> int:
    """Return the number of processes that share this work: one a core, as long as they fit into half the memory."""
    fit = int(0.5 * (memory or machine_memory()).total_mb / each_mb)
    return max(1, min(items, os.cpu_count() or 1, fit))


@cache
def processor_model() -> str:
    """Return the model of this machine's processor, as the system names it."""
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _groups(root: Path) -> Iterator[tuple[int, int]]:
    """Yield the limit and use, in bytes, of each group that confines this process (cgroups, version 1 and 2)."""
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="ascii").splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            base, names = root / "sys/fs/cgroup", ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            base = root / "sys/fs/cgroup/memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        group = base / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder == base or base in folder.parents:
                yield from _limit_of(folder, *names)


def _limit_of(folder: Path, limit: str, used: str, reclaimable: str) -> Iterator[tuple[int, int]]:
    try:
        stated = (folder / limit).read_text(encoding="ascii").strip()
        if stated == "max" or int(stated) >= _UNLIMITED:
            return
        statistics = dict(row.split() for row in (folder / "memory.stat").read_text(encoding="ascii").splitlines())
        now = int((folder / used).read_text(encoding="ascii")) - int(statistics.get(reclaimable, 0))
    except (OSError, ValueError):  # no such group here, or one without this controller
        return
    yield int(stated), now


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h
_LARGEST_KEPT = 32 << 20  # the largest value that glibc accepts
_MOST_KEPT = 1 << 30
_RETURNED = 1 << 20
# Of what is smaller: the arrays of the next block of faces need no cleared pages. With glibc's own 128 kB, more than
# half of the time went into these.
_SMALLER_KEPT = 32 << 20


def keep_freed_memory() -> None:
    """Keep freed memory instead of returning it to the system.

    Image processing allocates and frees thousands of arrays of several megabytes. By default glibc returns each to
    the system, which must clear it again for the next one; that takes up to half of the time. No effect with other C
    libraries.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
        libc.mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT)


@contextmanager
def large_arrays_returned() -> Generator[None]:
    """Return, within this block, each freed array of a megabyte or more to the system at once.

    Surfaces and their samples have few, large arrays of ever other sizes: of what is held back for the next ones,
    most would lie unused. Afterwards the process keeps what it frees, as a worker does.
    """
    return_freed_memory()
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(_M_MMAP_THRESHOLD, _RETURNED)
        libc.mallopt(_M_TRIM_THRESHOLD, _SMALLER_KEPT)
    try:
        yield
    finally:
        keep_freed_memory()


def return_freed_memory() -> None:
    """Return freed memory to the system, before a step whose arrays have other sizes."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def forget_pages(array: NDArray[np.generic]) -> None:
    """Give back the memory in which the file behind a mapped array is cached for this process; it is read again.

    No effect on other arrays, and on systems without this advice.
    """
    if isinstance(array, np.memmap) and array.mode == "c":
        return  # what was changed in memory alone would be lost
    base: object = array
    while isinstance(base, np.ndarray):
        base = cast("object", base.base)
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


_NICE = 10
_SESSION = Path("/proc/self/autogroup")


def compute_in_background() -> None:
    """Lower the priority of this process and of all that it starts.

    With autogroup scheduling, which is usual on desktop Linux, sessions get equal shares of the processor, and
    niceness counts only within one (man 7 sched). A process that leads a session therefore lowers its session too.
    No effect on systems without niceness.
    """
    if not hasattr(os, "nice"):
        return
    os.nice(_NICE)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # this system has no such groups
            _SESSION.write_text(str(_NICE), encoding="ascii")
