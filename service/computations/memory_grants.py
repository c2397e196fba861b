"""What memory the jobs on a machine have been granted, in small files that all its workers of a data folder share.

A job begins when it fits beside what runs. What was granted and is not used yet counts as used. One that waits for
others of these jobs to end is overtaken by none that came later, so that many small jobs cannot keep a large one
waiting for ever. One that waits for other programs to give memory back holds up nobody, and does so for ten minutes:
then a person is asked, since no job of ours will end and make room for it.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
from pydantic import ValidationError

from service.core.errors import ComputeError
from service.core.records.base import Record
from service.core.units import megabytes
from service.machine.resources import MachineMemory, machine_memory
from service.store.durable_effects import Clock
from service.store.runs import ProcessIdentity

_RESERVE_MB = 400.0  # for what else runs on the machine
_POLL_S = 0.5
ALONE = "waits until another one has ended: the seconds of each are measured"
_log = logging.getLogger(__name__)


class Grant(Record):
    """The memory that one process has been granted for its job, or waits for."""

    host: str
    boot: str
    pid: int
    process_started_s: float
    job: str
    memory_mb: float
    alone: bool = False  # beside no other such job
    waits: str = ""  # the reason, as a phrase; "" for one that has been granted
    place: int = 0  # the place in the queue of those that wait

    @property
    def lives(self) -> bool:
        """True if its process is not known to be dead."""
        identity = ProcessIdentity(self.host, self.boot, self.pid, self.process_started_s)
        return identity.life() != "dead"


@dataclass(frozen=True, slots=True)
class MemoryGrants:
    """The grants of this machine, as one process of a worker sees them.

    Attributes:
        data: the data folder.
        clock: the worker's clock.
        memory: returns the machine's memory.
        patience_s: the time for which a job waits for other programs alone.
    """

    data: Path
    clock: Clock
    memory: Callable[[], MachineMemory] = machine_memory
    patience_s: float = 600.0

    @contextmanager
    def granted(
        self, job: str, memory_mb: float, tell: Callable[[str], None], *, alone: bool = False
    ) -> Generator[None]:
        """Wait until a job fits beside what runs; within the block its memory is granted.

        Args:
            job: the job's id.
            memory_mb: the most that it needs, with what this process has already.
            tell: called with the reason of the wait, whenever that changes.
            alone: true to wait also until no other job that is to be alone is computed on this machine.

        Raises:
            ComputeError: the machine does not have that much, or other programs have occupied it for long.
        """
        whole = self.memory()
        if memory_mb > whole.total_mb - _RESERVE_MB:
            raise ComputeError(
                f"the job needs {memory_mb:.0f} MB of memory, and this machine has {whole.total_mb:.0f} MB, of which "
                f"{_RESERVE_MB:.0f} MB are kept for others",
                remedy="Start `orthocapture worker` on the same data folder on a machine with more memory, or give "
                "this one or its container more; then try again",
            )
        own = _folder(self.data) / f"{_here().host}-{os.getpid()}.json"
        grant = Grant(
            host=_here().host,
            boot=_here().boot,
            pid=os.getpid(),
            process_started_s=_here().process_started_s,
            job=job,
            memory_mb=memory_mb,
            alone=alone,
        )
        told, since_s = "", self.clock.monotonic_s()
        try:
            while (grant := self._take(own, grant)).waits:
                if grant.waits != told:
                    tell(grant.waits)
                    told = grant.waits
                if any(not other.waits for other in _grants(self.data)):
                    since_s = self.clock.monotonic_s()  # that one will end
                elif self.clock.monotonic_s() - since_s > self.patience_s:
                    raise ComputeError(
                        f"the job has waited {self.patience_s:.0f} s for memory that no computation uses: it "
                        f"{grant.waits}",
                        remedy="End other programs, or give this machine more memory; then try again",
                    )
                self.clock.sleep(_POLL_S)
            yield
        finally:
            with contextlib.suppress(OSError):
                own.unlink(missing_ok=True)

    def _take(self, own: Path, wanted: Grant) -> Grant:
        """Write down the grant, or what it waits for and at which place; returns it as it was written."""
        grant = wanted
        try:
            with _alone(own.parent):
                others = [found for found in _grants(self.data) if found.pid != wanted.pid]
                why = self._why_not(wanted, others)
                place = wanted.place or 1 + max((other.place for other in others if other.waits), default=0)
                grant = wanted.model_copy(update={"waits": why, "place": place if why else 0})
                part = own.with_suffix(".part")
                part.write_text(grant.model_dump_json(), encoding="utf-8")
                part.replace(own)
        except OSError as error:  # a disk that is full must not prevent a job from being computed
            _log.warning("the memory of jobs on this machine cannot be written down: %s", error)
            return wanted.model_copy(update={"waits": ""})
        return grant

    def _why_not(self, wanted: Grant, others: Sequence[Grant]) -> str:
        """Return why a job cannot start beside the others; "" if it can."""
        used_mb = {grant.pid: _used_mb(grant.pid) for grant in (wanted, *others)}
        granted = [other for other in others if not other.waits]
        if wanted.alone and any(other.alone for other in granted):
            return ALONE
        free_mb = self.memory().available_mb - _RESERVE_MB
        free_after_them_mb = free_mb + sum(used_mb[other.pid] for other in granted)
        free_mb -= sum(max(0.0, other.memory_mb - used_mb[other.pid]) for other in granted)
        needed_mb = max(0.0, wanted.memory_mb - used_mb[wanted.pid])
        if needed_mb > free_mb:
            return f"waits for memory: it needs {_rounded(needed_mb)} MB, {_rounded(free_mb)} MB are free"
        for other in others:
            earlier = bool(other.waits) and other.waits != ALONE and (not wanted.place or other.place < wanted.place)
            if earlier and other.memory_mb - used_mb[other.pid] <= free_after_them_mb:
                return f"waits for memory: one that needs {_rounded(other.memory_mb)} MB has waited longer"
        return ""


def waiting_for_memory(data: Path) -> dict[str, str]:
    """Return why each job on this machine that waits for memory does so, as text by the job's id."""
    return {grant.job: grant.waits for grant in _grants(data) if grant.waits}


def computes_alone(data: Path) -> bool:
    """Return whether a job that is to be alone is computed on this machine."""
    return any(grant.alone and not grant.waits for grant in _grants(data))


def _grants(data: Path) -> Iterator[Grant]:
    """Yield the grants of living processes of this machine; remove the files of dead ones."""
    for path in sorted(_folder(data).glob(f"{_here().host}-*.json")):
        try:
            grant = Grant.model_validate_json(path.read_bytes())
        except (OSError, ValidationError):
            continue
        if grant.lives:
            yield grant
        else:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


@contextmanager
def _alone(folder: Path) -> Generator[None]:
    """Hold the lock of the folder. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _used_mb(pid: int) -> float:
    """Return the memory of a process and of those that it started; 0 for one that has ended."""
    try:
        process = psutil.Process(pid)
        return sum(megabytes(one.memory_info().rss) for one in (process, *process.children(recursive=True)))
    except psutil.Error:
        return 0.0


def _rounded(memory_mb: float) -> int:
    """Round to 50 MB, so that the text does not change all the time."""
    return max(0, 50 * round(memory_mb / 50))


def _here() -> ProcessIdentity:
    return ProcessIdentity.of_this_process()


def _folder(data: Path) -> Path:
    return data / "monitor" / "memory"
