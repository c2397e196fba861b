"""The connection to a Dask cluster; the package `distributed` is imported when it is opened."""

from __future__ import annotations

import logging
import time
from concurrent.futures import CancelledError, Future
from typing import TYPE_CHECKING, Any

from service.core.errors import ComputeError, ConfigurationError
from service.machine.dask_files import FileSender, compute_asking
from service.machine.recovering import ConnectionLostError
from service.machine.remote_task import (
    RemoteResult,
    RemoteTask,
    different_versions,
    version_error,
    versions_here,
)

if TYPE_CHECKING:
    from service.machine.schedulers import Scheduler

_log = logging.getLogger(__name__)
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
