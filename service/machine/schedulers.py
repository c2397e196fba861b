"""Executors of other machines: those of a Dask cluster, or what a plug-in opens for the scheme of an address."""

from __future__ import annotations

import logging
import time
from collections.abc import Generator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from service.core.errors import ConfigurationError
from service.core.loading import plug_ins
from service.machine.executors import IN_THIS_PROCESS, InThisProcess, local_pool, noted_places
from service.machine.recovering import ClusterConnection, ConnectionLostError, RecoveringExecutor
from service.machine.remote_task import RemoteResult, RemoteTask, compute_there

GROUP = "orthocapture.executors"
_DASK = ("tcp", "tls")
_REST_S = 60.0  # without a cluster before the next try to connect
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Scheduler:
    """The address of a scheduler and how to reach it.

    Attributes:
        address: `tcp://host:port` or `tls://host:port` of a Dask scheduler; another scheme is that of a plug-in.
        ca: the file of the authority that signed the certificates, for tls.
        cert: the file of this machine's certificate, for tls.
        key: the file of its key, for tls.
        patience_s: the time without an answer or a worker after which the cluster counts as lost.
    """

    address: str
    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None
    patience_s: float = 30.0

    def __post_init__(self) -> None:
        """Check what is given. Raises ConfigurationError."""
        given = [file for file in (self.ca, self.cert, self.key) if file is not None]
        if self.scheme == "tls" and len(given) < 3:
            raise ConfigurationError(
                "a scheduler reached by tls needs three files",
                where=self.address,
                remedy="Give --scheduler-ca, --scheduler-cert and --scheduler-key",
            )
        if self.scheme == "tcp" and given:
            raise ConfigurationError(
                "files for tls are given, but the address says tcp, which is not encrypted",
                where=self.address,
                remedy=f"Give tls{self.address.removeprefix('tcp')}",
            )
        for file in given:
            if not file.is_file():
                raise ConfigurationError("the file does not exist", where=str(file), remedy="Check its path")
        if self.scheme not in _DASK and not any(point.name == self.scheme for point in plug_ins(GROUP)):
            known = ", ".join([f"{name}://host:port" for name in _DASK] + [f"{p.name}://…" for p in plug_ins(GROUP)])
            raise ConfigurationError(
                "the address of the scheduler is of no known kind", where=self.address, remedy=f"Give {known}"
            )

    @property
    def scheme(self) -> str:
        """The part of the address before `://`; "" if there is none."""
        return self.address.partition("://")[0] if "://" in self.address else ""


class PlugInConnection:
    """Makes a connection of any executor: it counts as lost when it says that it is broken."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, task: RemoteTask, /) -> Future[RemoteResult]:
        """Send a task. Raises ConnectionLostError if the executor is broken."""
        try:
            return self._executor.submit(compute_there, task)
        except BrokenExecutor as error:
            raise ConnectionLostError(f"the executor is broken: {error}") from error

    def trouble(self) -> str:
        """Return "": nothing is known of an executor besides its answers."""
        return ""

    def explained(self, error: BaseException) -> BaseException:
        """Return ConnectionLostError for a broken executor, and the error itself for others."""
        broken = isinstance(error, (BrokenExecutor, CancelledError))
        return ConnectionLostError(f"the executor is broken: {error!r}") if broken else error

    def close(self) -> None:
        """Shut the executor down without waiting."""
        self._executor.shutdown(wait=False, cancel_futures=True)


class RemoteExecutors:
    """Opens executors on other machines, over one connection that is made when it is first needed.

    Without a connection, and once one is lost, work is computed by processes of this machine; the next work tries to
    connect again, a minute later.
    """

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._connection: ClusterConnection | None = None
        self._not_before_s = float("-inf")

    def connect(self) -> None:
        """Connect at once.

        Raises:
            ConfigurationError: no scheduler or no worker answers, versions differ, or a package is missing.
        """
        try:
            self._connected()
        except ConnectionLostError as error:
            raise ConfigurationError(
                str(error),
                where=self._scheduler.address,
                remedy="Start the scheduler and its workers (docs/howto/cluster.md), or compute without --scheduler",
            ) from error

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    @contextmanager
    def open(self, processes: int, items: int) -> Generator[Executor]:
        """Open an executor. Raises ConfigurationError as `connect` for other versions and missing packages."""
        if processes == IN_THIS_PROCESS or items <= 1:
            yield InThisProcess()
            return
        at_once = max(1, min(processes, items))
        try:
            connection = self._connected()
        except ConnectionLostError as error:
            if str(error):
                _log.warning("the cluster cannot be used: %s; this machine computes alone", error)
            with InThisProcess() if at_once == 1 else local_pool(at_once) as executor:
                yield executor
            return
        with RecoveringExecutor(connection, partial(local_pool, at_once), noted_places()) as executor:
            yield executor

    def _connected(self) -> ClusterConnection:
        """Return the connection. Raises ConnectionLostError, ConfigurationError."""
        if self._connection is not None and self._connection.trouble():
            self.close()
        if self._connection is None:
            if time.monotonic() < self._not_before_s:
                raise ConnectionLostError
            try:
                self._connection = _connection(self._scheduler)
            except ConnectionLostError:
                self._not_before_s = time.monotonic() + _REST_S
                raise
        return self._connection


def _connection(scheduler: Scheduler) -> ClusterConnection:
    """Connect. Raises ConnectionLostError, ConfigurationError."""
    for point in plug_ins(GROUP):
        if point.name == scheduler.scheme:
            opened = point.load()(scheduler)
            if not isinstance(opened, Executor):
                raise ConfigurationError(
                    f"the plug-in {point.value} returned no concurrent.futures.Executor", where=scheduler.address
                )
            return PlugInConnection(opened)
    from service.machine.dask_cluster import DaskConnection  # noqa: PLC0415 - an optional package

    return DaskConnection(scheduler)
