"""Executors of other machines, of a Dask cluster or a plug-in; tasks are computed here if the connection is lost."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar

from service.core.errors import ComputeError, ConfigurationError
from service.core.loading import plug_ins
from service.machine.dask_files import FileSender, compute_asking
from service.machine.executors import IN_THIS_PROCESS, InThisProcess, Place, local_pool, noted_places
from service.machine.remote_task import (
    RemoteResult,
    RemoteTask,
    compute_there,
    different_versions,
    remote_task,
    version_error,
    versions_here,
    write_here,
)

_log = logging.getLogger(__name__)
_LOOK_S = 1.0  # between looks at the connection
_Result = TypeVar("_Result")
_P = ParamSpec("_P")


class ConnectionLostError(Exception):
    """The scheduler or all of its workers are gone, or it does not answer; the text says which."""


class ClusterConnection(Protocol):
    """A connection to the scheduler of other machines."""

    def submit(self, task: RemoteTask, /) -> Future[RemoteResult]:
        """Send a task, for `compute_there`. Raises ConnectionLostError if that is known to be in vain."""
        ...

    def trouble(self) -> str:
        """Say why nothing more is to be expected of the other machines; "" while they work."""
        ...

    def explained(self, error: BaseException) -> BaseException:
        """Return an error of a task as one of ours: ConnectionLostError if it was not the task's."""
        ...

    def close(self) -> None:
        """Close the connection; the other machines forget the tasks without an answer."""
        ...


@dataclass
class _Open:
    """A call without an answer: what computes it now.

    `taken`: this machine computes it, or has begun to take the answer of another one.
    """

    call: Callable[[], Any]
    inner: Future[Any] | None = None
    taken: bool = False


class RecoveringExecutor(Executor):
    """Computes calls over a connection; once that is lost, it computes those without an answer here."""

    def __init__(self, connection: ClusterConnection, local: Callable[[], Executor], places: Counter[Place]) -> None:
        """Watch the connection.

        Args:
            connection: the connection to the other machines.
            local: opens the executor that takes over.
            places: counts the tasks of each place.
        """
        self._connection, self._make_local, self._places = connection, local, places
        self._lock = threading.Lock()
        self._open: dict[Future[Any], _Open] = {}
        self._local: Executor | None = None
        # Answers come in the thread that also talks to the scheduler: it must not wait for the disk.
        self._writing = ThreadPoolExecutor(1, thread_name_prefix="cluster-files")
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._look, name="cluster-watch", daemon=True)
        self._watch.start()

    def submit(self, fn: Callable[_P, _Result], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_Result]:
        """Compute a call on another machine, or here if there is none any more."""
        outer: Future[_Result] = Future()
        call = partial(fn, *args, **kwargs)
        task = remote_task(call)
        with self._lock:
            self._open[outer] = _Open(call)
            here = self._local is not None
        outer.add_done_callback(self._drop)
        if here:
            self._compute_here(outer)
            return outer
        try:
            inner = self._connection.submit(task)
        except ConnectionLostError as error:
            self._lose(str(error))
            return outer
        with self._lock:
            entry = self._open.get(outer)
            if entry is not None and not entry.taken:
                entry.inner = inner
        inner.add_done_callback(partial(self._take_answer, outer))
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the calls without an answer, or with `cancel_futures` cancel them, and end the watch."""
        with self._lock:
            open_now = list(self._open)
        if cancel_futures:
            for future in open_now:
                future.cancel()
        if wait:
            _wait_for(open_now)
        self._ended.set()
        if wait and self._watch is not threading.current_thread():
            self._watch.join()
        self._writing.shutdown(wait=wait, cancel_futures=cancel_futures)
        if self._local is not None:
            self._local.shutdown(wait=wait, cancel_futures=cancel_futures)

    def _look(self) -> None:
        while not self._ended.wait(_LOOK_S):
            trouble = self._connection.trouble()
            if trouble:
                self._lose(trouble)
                return

    def _take_answer(self, outer: Future[Any], inner: Future[RemoteResult]) -> None:
        """Take a task's answer from another machine."""
        error: BaseException | None
        try:
            error = inner.exception()
        except CancelledError as cancelled:
            error = cancelled
        if error is not None:
            if outer.cancelled():
                return
            error = self._connection.explained(error)
        if isinstance(error, ConnectionLostError):
            self._lose(str(error))
            return
        with self._lock:
            entry = self._open.get(outer)
            if entry is None or entry.taken:  # computed here meanwhile
                return
            entry.taken = True
        if error is not None:
            _settle(outer, None, error)
        elif inner.result().written:
            self._writing.submit(self._give, outer, inner.result())
        else:
            self._give(outer, inner.result())

    def _give(self, outer: Future[Any], answer: RemoteResult) -> None:
        """Write the files of an answer, and give the value to who asked."""
        try:
            write_here(answer.written)
        except OSError as error:
            _settle(outer, None, error)
            return
        self._places[answer.place] += 1
        _settle(outer, answer.value, None)

    def _lose(self, why: str) -> None:
        """Let everything without an answer be computed here, from now on."""
        with self._lock:
            if self._local is not None:
                moved = [outer for outer, entry in self._open.items() if not entry.taken]
            else:
                moved = list(self._open)
                _log.warning(
                    "the cluster is lost: %s; %d tasks without an answer are computed on this machine",
                    why,
                    len(moved),
                )
                self._local = self._make_local()
        for outer in moved:
            self._compute_here(outer)

    def _compute_here(self, outer: Future[Any]) -> None:
        with self._lock:
            entry = self._open.get(outer)
            if entry is None or entry.taken or self._local is None:
                return
            entry.taken = True
            local = self._local
        try:
            inner = local.submit(entry.call)
        except (BrokenProcessPool, RuntimeError) as error:
            _settle(outer, None, error)
            return
        inner.add_done_callback(partial(_pass_on, outer))

    def _drop(self, outer: Future[Any]) -> None:
        with self._lock:
            entry = self._open.pop(outer, None)
        if outer.cancelled() and entry is not None and entry.inner is not None:
            entry.inner.cancel()


def _pass_on(outer: Future[Any], inner: Future[Any]) -> None:
    if inner.cancelled():
        outer.cancel()
        return
    error = inner.exception()
    _settle(outer, None if error is not None else inner.result(), error)


def _settle(outer: Future[Any], value: object, error: BaseException | None) -> None:
    """Give a future its result or error, unless it was cancelled."""
    if not outer.set_running_or_notify_cancel():
        return
    if error is None:
        outer.set_result(value)
    else:
        outer.set_exception(error)


def _wait_for(futures: list[Future[Any]]) -> None:
    wait(futures)


_CLOSE_S = 5.0


class DaskConnection:
    """A client of a Dask scheduler, whose workers all have the versions of this program."""

    def __init__(self, scheduler: Scheduler) -> None:
        """Connect, wait for a worker and compare versions.

        Raises:
            ConnectionLostError: no scheduler answers in time, or it has no worker.
            ConfigurationError: the package is not installed, or a machine has other versions.
        """
        try:
            import distributed  # noqa: PLC0415 - optional
            from distributed.client import ClosedClientError  # noqa: PLC0415
            from distributed.comm.core import CommClosedError  # noqa: PLC0415
        except ImportError as error:
            raise ConfigurationError(
                "a Dask cluster needs the package distributed, which is not installed",
                where=scheduler.address,
                remedy='Run `pip install "orthocapture[cluster]"` in this environment, or leave --scheduler out',
            ) from error
        self._distributed, self._lost = distributed, (CancelledError, CommClosedError)
        self._closed = (ClosedClientError, OSError)
        self._address, self._patience_s = scheduler.address, scheduler.patience_s
        self._without_worker_since_s: float | None = None
        for name in ("distributed", "distributed.client"):  # what matters of them is said here
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            self._client: Any = distributed.Client(
                scheduler.address,
                timeout=scheduler.patience_s,
                set_as_default=False,
                security=_security(distributed, scheduler),
            )
        except (OSError, ValueError) as error:
            raise ConnectionLostError(f"no scheduler answers at {scheduler.address}: {error}") from error
        try:
            self._require_workers()
        except BaseException:
            self._close_client()
            raise
        # Not pure: Dask would otherwise take a file that has changed under its path for the same argument.
        self._executor = self._client.get_executor(pure=False)
        try:
            self._files = FileSender(self._client)
        except self._closed as error:
            self._close_client()
            raise ConnectionLostError(f"the connection to {self._address} has ended: {error}") from error

    def submit(self, task: RemoteTask, /) -> Future[RemoteResult]:
        """Send a task. Raises ConnectionLostError if the client is closed."""
        if self._client.status != "running":
            raise ConnectionLostError(f"the connection to {self._address} has ended")
        try:
            future: Future[RemoteResult] = self._executor.submit(compute_asking, task, self._files.topic)
        except self._closed as error:
            raise ConnectionLostError(f"the connection to {self._address} has ended: {error}") from error
        return future

    def trouble(self) -> str:
        """Ask the scheduler for its workers; say what is wrong if it does not answer, or has had none for long."""
        if self._client.status != "running":
            return f"the connection to {self._address} has ended"
        try:
            workers = self._client.sync(self._client.scheduler.ncores, callback_timeout=self._patience_s)
        except TimeoutError:
            return f"the scheduler at {self._address} has not answered for {self._patience_s:.0f} s"
        except (OSError, RuntimeError, AttributeError) as error:  # the connection, or its loop, has just ended
            return f"the connection to {self._address} has ended: {error}"
        if workers:
            self._without_worker_since_s = None
            return ""
        now_s = time.monotonic()
        if self._without_worker_since_s is None:
            self._without_worker_since_s = now_s
        if now_s - self._without_worker_since_s > self._patience_s:
            return f"the scheduler at {self._address} has had no worker for {self._patience_s:.0f} s"
        return ""

    def explained(self, error: BaseException) -> BaseException:
        """Return ConnectionLostError for a lost connection, ComputeError for a task that kills workers."""
        if isinstance(error, self._lost):
            return ConnectionLostError(f"the scheduler at {self._address} has dropped its tasks")
        if isinstance(error, self._distributed.KilledWorker):
            return ComputeError(
                f"a task has killed every worker that computed it: {_deaths(error)}",
                where=self._address,
                remedy="Look for the reason in the logs of the Dask workers, such as too little memory; or compute "
                "without --scheduler",
            )
        return error

    def close(self) -> None:
        """Close the client without waiting for long; workers remove the files that were sent to them."""
        self._files.close(_CLOSE_S)
        self._close_client()

    def _close_client(self) -> None:
        try:
            self._client.close(timeout=_CLOSE_S)
        except (OSError, RuntimeError) as error:
            _log.info("the connection to %s did not close: %s", self._address, error)

    def _require_workers(self) -> None:
        """Wait for a worker, and compare the versions of scheduler and workers with those of this process.

        Raises ConnectionLostError, ConfigurationError.
        """
        try:
            self._client.wait_for_workers(1, timeout=self._patience_s)
        except TimeoutError as error:
            raise ConnectionLostError(
                f"the scheduler at {self._address} has had no worker for {self._patience_s:.0f} s"
            ) from error
        try:
            found: dict[str, Any] = self._client.run(versions_here)
            found["scheduler"] = self._client.run_on_scheduler(versions_here)
        except (OSError, TimeoutError) as error:
            raise ConnectionLostError(f"the connection to {self._address} has ended: {error}") from error
        except Exception as error:  # whatever the other machine raised
            raise ConfigurationError(
                f"the versions on the cluster cannot be compared: {type(error).__name__}: {error}",
                where=self._address,
                remedy="Install orthocapture with its extra cluster on the scheduler and on every worker",
            ) from error
        for machine, versions in found.items():
            differing = different_versions(versions_here(), versions)
            if differing:
                raise version_error(machine, differing)


def _deaths(error: Any) -> str:
    last = getattr(error, "last_worker", None)
    return f"the last was {getattr(last, 'address', last)}, after {getattr(error, 'allowed_failures', '?')} others"


def _security(distributed: Any, scheduler: Scheduler) -> Any:
    """Return the client's side of tls; None without it."""
    if scheduler.scheme != "tls":
        return None
    return distributed.Security(
        tls_ca_file=str(scheduler.ca),
        tls_client_cert=str(scheduler.cert),
        tls_client_key=str(scheduler.key),
        require_encryption=True,
    )


GROUP = "orthocapture.executors"
_DASK = ("tcp", "tls")
_REST_S = 60.0  # without a cluster before the next try to connect


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

    return DaskConnection(scheduler)
