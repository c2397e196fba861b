"""A Dask cluster for tests: a scheduler and workers, each a process of its own on a free port."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
import psutil

from service.machine.executors import computing_at
from service.machine.schedulers import Scheduler
from tests.support.processes.waiting import until
from tests.support.processes.zygote import CLUSTER
from tests.support.rig.rig import REPOSITORY

_SCHEDULER, _WORKER = CLUSTER


@dataclass
class Cluster:
    """The processes of a cluster and the address of its scheduler."""

    address: str
    folder: Path
    options: Sequence[str]
    scheduler: subprocess.Popen[bytes]
    start: type[subprocess.Popen[bytes]]
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list[subprocess.Popen[bytes]])

    def add_worker(self, environment: Mapping[str, str] | None = None, *options: str) -> subprocess.Popen[bytes]:
        """Start a worker with one thread, which computes one task at a time."""
        name = f"worker{len(self.workers)}"
        one = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder))
        log = self.folder / f"{name}.log"
        worker = _start(self.start, [_WORKER, self.address, *one, *self.options, *options], log, environment or {})
        self.workers.append(worker)
        return worker


@contextmanager
def dask_cluster(
    folder: Path,
    *,
    workers: int = 2,
    nannies: bool = True,
    options: Sequence[str] = (),
    scheme: str = "tcp",
    start: type[subprocess.Popen[bytes]] = subprocess.Popen,
) -> Generator[Cluster]:
    """Start a scheduler and workers; end them after the block.

    `nannies`: whether these workers are started again when they die. `options` are given to each, such as files for
    tls. With `start=Forked`, they are forks of the zygote.
    """
    where = folder / "scheduler.json"
    ports = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(where))
    security = ("--protocol", scheme, *options)
    scheduler = _start(start, [_SCHEDULER, *ports, *security], folder / "scheduler.log", {})
    cluster = Cluster("", folder, security, scheduler, start)
    try:
        until(lambda: bool(_address(where)), lambda: (folder / "scheduler.log").read_text(encoding="utf-8"))
        cluster.address = _address(where)
        for _ in range(workers):
            cluster.add_worker(None, *(() if nannies else ("--no-nanny",)))
        yield cluster
    finally:
        for process in [scheduler, *cluster.workers]:
            end_tree(process)


def _address(where: Path) -> str:
    """Return the address in a scheduler's file; "" while it is being written."""
    try:
        return str(json.loads(where.read_text(encoding="utf-8"))["address"])
    except (FileNotFoundError, json.JSONDecodeError):
        return ""


def end_tree(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and those that it started."""
    if process.poll() is None:
        with suppress(psutil.NoSuchProcess):  # a worker ends by itself when its scheduler has
            for child in psutil.Process(process.pid).children(recursive=True):
                with suppress(psutil.NoSuchProcess):
                    child.kill()
        process.kill()
    process.wait()


def _start(
    start: type[subprocess.Popen[bytes]], options: Sequence[str], log: Path, environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    own = {**os.environ, "PYTHONPATH": str(REPOSITORY), **environment}
    with log.open("wb") as output:
        return start(
            [sys.executable, "-m", *options], cwd=log.parent, env=own,
            stdin=subprocess.DEVNULL, stdout=output, stderr=output,
        )  # fmt: skip


@contextmanager
def stopped(cluster: Cluster) -> Generator[None]:
    """Stop the workers, which begin nothing meanwhile."""
    processes: list[psutil.Process] = []
    for worker in cluster.workers:
        nanny = psutil.Process(worker.pid)
        processes += [nanny, *nanny.children(recursive=True)]
    for process in processes:
        process.suspend()
    try:
        yield
    finally:
        for process in processes:
            process.resume()


@contextmanager
def on(cluster: Cluster, patience_s: float = 60.0) -> Generator[None]:
    """Compute on a cluster that has answered."""
    with computing_at(Scheduler(cluster.address, patience_s=patience_s)):
        yield


def bits(value: object) -> object:
    """Return every number of a result as its bits."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if isinstance(value, float):
        return value.hex()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *(bits(getattr(value, field.name)) for field in dataclasses.fields(value))]
    if isinstance(value, Mapping):
        return [(bits(k), bits(v)) for k, v in cast("Mapping[object, object]", value).items()]
    if isinstance(value, (list, tuple)):
        return [bits(part) for part in cast("Sequence[object]", value)]
    return repr(value)
