"""Limits on what processes may use together: control groups of Linux, of the first version, which need root."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from service.core.units import seconds_of_ns

_ROOT = Path("/sys/fs/cgroup")
_PERIOD_US = 100_000


@dataclass(frozen=True, slots=True)
class Limits:
    """Holds what a group of processes may use; None: as much as there is."""

    processors: float | None = None
    memory_mb: int | None = None


@dataclass(frozen=True, slots=True)
class Group:
    """A group of processes with limits."""

    folders: tuple[Path, ...]

    def enter(self) -> None:
        """Put this process into the group, and with it those that it starts; called between fork and exec."""
        for folder in self.folders:
            (folder / "cgroup.procs").write_text(str(os.getpid()))

    def enlarge_memory(self, by: float) -> None:
        """Let the group use so many times as much memory, as a person does who ends other programs."""
        for folder in self.folders:
            limit = folder / "memory.limit_in_bytes"
            if limit.exists():
                limit.write_text(str(int(int(limit.read_text()) * by)))

    def throttled_s(self) -> float:
        """Seconds in which the group was to run and was not let."""
        told = [line.split() for folder in self.folders for line in _lines(folder / "cpu.stat")]
        return sum(seconds_of_ns(int(number)) for name, number in told if name == "throttled_time")


@contextmanager
def group(name: str, limits: Limits) -> Generator[Group]:
    """A group with these limits; the processes in it must have ended at the end of the block."""
    wanted: list[tuple[str, Callable[[Path], None]]] = []
    if limits.processors is not None:
        quota_us = int(limits.processors * _PERIOD_US)
        wanted.append(("cpu", lambda folder: _write(folder / "cpu.cfs_quota_us", quota_us)))
    if limits.memory_mb is not None:
        most = limits.memory_mb << 20
        wanted.append(("memory", lambda folder: _write(folder / "memory.limit_in_bytes", most)))
    folders: list[Path] = []
    try:
        for controller, limit in wanted:
            folder = _ROOT / controller / f"orthocapture-{os.getpid()}-{name}"
            folder.mkdir()
            folders.append(folder)
            limit(folder)
        yield Group(tuple(folders))
    finally:
        for folder in folders:
            with suppress(OSError):  # a process is still ending in it
                folder.rmdir()


def _write(path: Path, number: int) -> None:
    path.write_text(str(number))


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []
