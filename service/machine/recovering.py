"""An executor on other machines whose tasks are computed here if the connection to them is lost."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, Protocol, TypeVar

from service.machine.executors import Place
from service.machine.remote_task import RemoteResult, RemoteTask, remote_task, write_here

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
