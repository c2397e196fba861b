"""The memory of this machine, or of the group of processes to which this one is confined."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil

from service.core.units import megabytes

IMAGE_MB = 1000.0  # estimated, of a process that looks at one photograph of 60 megapixels after the other
_UNLIMITED = 1 << 60  # what older kernels state where there is no limit is larger


@dataclass(frozen=True, slots=True)
class MachineMemory:
    """All of the memory, and what is free or can be freed at once."""

    total_mb: float
    available_mb: float


def machine_memory(root: Path = Path("/")) -> MachineMemory:
    """The memory that this process and others like it can have: the machine's, or less in a container or a group.

    Args:
        root: above `proc` and `sys`.
    """
    machine = psutil.virtual_memory()
    total, available = machine.total, machine.available
    for limit, used in _groups(root):
        if limit < min(total, _UNLIMITED):
            total = limit
        available = min(available, max(0, limit - used))
    return MachineMemory(megabytes(total), megabytes(available))


def processes_for(items: int, each_mb: float, memory: MachineMemory | None = None) -> int:
    """The number of processes that share this work: one a core, as long as they fit into half of the memory."""
    fit = int(0.5 * (memory or machine_memory()).total_mb / each_mb)
    return max(1, min(items, os.cpu_count() or 1, fit))


def _groups(root: Path) -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of each group that confines this process (cgroups, version 1 and 2)."""
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
