"""Sends files to the workers of a Dask cluster that do not see them, when a task asks for them.

A task asks for the files that it does not see, by an event, and waits: Dask alone decides which worker computes what.
The job's machine answers two requests at a time, in pieces, past the queue of tasks: no process holds more of a file
than a piece. A worker's process stores the files in its own folder for later tasks, up to a limit.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
import shutil
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from service.core.errors import DataError
from service.core.units import megabytes
from service.machine.executors import this_place
from service.machine.remote_task import REMEDY, NeededFile, RemoteResult, RemoteTask, compute_there, stamp_of

if TYPE_CHECKING:
    from _hashlib import HASH

_log = logging.getLogger(__name__)
MOST_BYTES = 2_000_000_000  # for one task: the memory that is planned for a worker, whose folder may be in memory
_MOST_HELD_BYTES = 2 * MOST_BYTES
_PIECE_BYTES = 32 << 20
_SENDERS = 2  # while the scheduler passes on a piece of one file, it gets one of another
_ASK_AGAIN_S = 30.0  # without a piece: the job's machine answers other workers meanwhile
_LOOK_S = 1.0


def compute_asking(task: RemoteTask, topic: str) -> RemoteResult:
    """Compute a task in a worker that asks under a topic for the files that it does not see.

    Raises ConfigurationError, DataError: as `compute_there`.
    """
    return compute_there(task, _Asking(topic))


class FileSender:
    """Answers the workers that ask for files, in threads of its own."""

    def __init__(self, client: Any) -> None:
        """Listen for requests under a topic that no other client has."""
        self.topic = f"orthocapture-files-{uuid4().hex}"
        self._client = client
        self._asked: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._open: set[tuple[str, str]] = set()
        self._threads: list[threading.Thread] = []
        self._closing = threading.Event()
        client.subscribe_topic(self.topic, self._take)

    def close(self, patience_s: float) -> None:
        """Send no more, and let the workers remove what they have; do not wait for longer than that."""
        self._closing.set()
        if self._threads:
            end = threading.Thread(target=self._end, name="cluster-sender-end", daemon=True)
            end.start()
            end.join(patience_s)

    def _take(self, event: tuple[float, dict[str, Any]]) -> None:
        """Put a request into the queue; called in the thread that talks to the scheduler."""
        request = event[1]
        who = (str(request["worker"]), str(request["key"]))
        if who in self._open or self._closing.is_set():  # asked again while it waits, or in vain
            return
        self._open.add(who)
        self._asked.put(request)
        if len(self._threads) < _SENDERS:
            self._threads.append(threading.Thread(target=self._answer, name="cluster-sender", daemon=True))
            self._threads[-1].start()

    def _answer(self) -> None:
        while (request := self._asked.get()) is not None:
            worker, key = str(request["worker"]), str(request["key"])
            try:
                self._send(worker, key, NeededFile(**request["file"]))
            except Exception as error:  # noqa: BLE001 - whatever the other machine raised; it asks again, or is gone
                _log.info("a file could not be sent to %s: %r", worker, error)
            self._open.discard((worker, key))

    def _end(self) -> None:
        for _ in self._threads:
            self._asked.put(None)
        for thread in self._threads:
            thread.join()
        try:
            self._client.run(forget_files, self.topic, on_error="ignore")
        except Exception as error:  # noqa: BLE001 - the workers remove them when they end
            _log.info("the workers did not remove what was sent to them: %r", error)

    def _send(self, worker: str, key: str, needed: NeededFile) -> None:
        """Send a file, or why it cannot be sent. Raises whatever the connection or the worker raises."""
        digest, at, problem = hashlib.sha256(), 0, ""
        try:
            for piece in _pieces(needed):
                digest.update(piece)
                if not self._tell(worker, receive_piece, key, at, piece):
                    return
                at += len(piece)
        except _NotSentError as error:
            problem = str(error)
        if not problem and needed.sha256 and needed.sha256 != digest.hexdigest():
            problem = "its content does not have the hash that its name says"
        self._tell(worker, end_file, key, digest.hexdigest(), problem)

    def _tell(self, worker: str, do: Callable[..., bool], *arguments: object) -> bool:
        """Call a function in a worker. Raises whatever the connection or the worker raises."""
        if self._closing.is_set():
            return False
        answers: dict[str, bool] = self._client.run(do, *arguments, workers=[worker])
        return all(answers.values()) and bool(answers)


class _NotSentError(Exception):
    """A file of the job's machine cannot be sent; the text says why."""


def _pieces(needed: NeededFile) -> Iterator[bytes]:
    """Yield the content of a file. Raises _NotSentError."""
    try:
        with Path(needed.path).open("rb") as file:
            _require_unchanged(needed, os.fstat(file.fileno()))
            while piece := file.read(_PIECE_BYTES):
                yield piece
            _require_unchanged(needed, os.fstat(file.fileno()))
    except OSError as error:
        raise _NotSentError(f"it cannot be read any more: {error.strerror}") from error


def _require_unchanged(needed: NeededFile, stat: os.stat_result) -> None:
    """Raise _NotSentError if a file is not what it was when the task was made."""
    if (stat.st_size, stat.st_mtime_ns) != (needed.size_bytes, needed.changed_ns):
        raise _NotSentError("it has changed since the task was made")


@dataclass
class _Held:
    """A file in the folder of this process, or what has arrived of it.

    Attributes:
        needed: the file as the job's machine has it.
        topic: names the connection over which it comes.
        path: its path here, under its name.
        digest: the hash of what has arrived.
        size_bytes: the size of what has arrived.
        news_s: when it was asked for, or its last piece arrived.
        complete: True once it has arrived.
        problem: why it does not come; "" while it may.
        users: the number of tasks that use it now.
    """

    needed: NeededFile
    topic: str
    path: Path
    digest: HASH = field(default_factory=hashlib.sha256)
    size_bytes: int = 0
    news_s: float = 0.0
    complete: bool = False
    problem: str = ""
    users: int = 0


_held: dict[str, _Held] = {}  # of this process, by key; those last used are last
_news = threading.Condition()


def receive_piece(key: str, at: int, piece: bytes) -> bool:
    """Take a piece of a file, in the worker; False if nobody waits for it any more."""
    with _news:
        held = _held.get(key)
        if held is None or held.complete or held.problem:
            return False
        if at == 0:
            held.digest, held.size_bytes = hashlib.sha256(), 0
        try:
            with held.path.open("r+b" if at else "wb") as file:
                file.seek(at)
                file.write(piece)
        except OSError as error:
            held.problem = f"this machine cannot write it: {error.strerror}"
        held.digest.update(piece)
        held.size_bytes += len(piece)
        held.news_s = time.monotonic()
        _news.notify_all()
        return not held.problem


def end_file(key: str, sha256: str, problem: str) -> bool:
    """Take the end of a file, in the worker, with the hash of what was sent, or why it cannot be sent."""
    with _news:
        held = _held.get(key)
        if held is None or held.complete:
            return False
        if not problem and held.needed.size_bytes == 0:
            held.path.touch()
        elif not problem and (held.size_bytes, held.digest.hexdigest()) != (held.needed.size_bytes, sha256):
            problem = "it has arrived with another size or hash"
        held.complete, held.problem = not problem, held.problem or problem
        _news.notify_all()
        return True


def forget_files(topic: str) -> None:
    """Remove the files that came over a connection, except what a task uses, in the worker."""
    with _news:
        for key in [key for key, held in _held.items() if held.topic == topic and not held.users]:
            _remove(key)


def _remove(key: str) -> None:
    shutil.rmtree(_held.pop(key).path.parent, ignore_errors=True)


class _Asking:
    """Asks the job's machine for files, from a task in a worker of Dask."""

    def __init__(self, topic: str) -> None:
        from distributed import get_worker  # noqa: PLC0415 - optional

        self._worker: Any = get_worker()
        self._task_key: str = self._worker.get_current_task()
        self._topic = topic

    @property
    def folder(self) -> Path:
        """The worker's own folder, which Dask removes when it has ended, or before another starts there."""
        return Path(self._worker.local_directory)

    @contextmanager
    def provided(self, files: Sequence[NeededFile]) -> Generator[list[Path]]:
        """Provide files, which are the same files for later tasks. Raises DataError if one does not come."""
        self._require_size(files)
        keys = [self._key(needed) for needed in files]
        used: list[str] = []
        try:
            with _news:
                for key, needed in zip(keys, files, strict=True):
                    self._use(key, needed)
                    used.append(key)
            for key in keys:
                self._wait_for(key)
            with _news:
                paths = [_held[key].path for key in keys]
            before = [stamp_of(path) for path in paths]
            try:
                yield paths
            finally:
                with _news:
                    for key, path, stamp in zip(keys, paths, before, strict=True):
                        if stamp_of(path) != stamp:
                            _held[key].problem = "a task has changed it here"
        finally:
            with _news:
                self._leave(used)

    def _require_size(self, files: Sequence[NeededFile]) -> None:
        """Refuse what is too large. Raises DataError."""
        size_bytes = sum(needed.size_bytes for needed in files)
        if size_bytes > MOST_BYTES:
            host, largest = this_place().host, max(files, key=lambda needed: needed.size_bytes).path
            raise DataError(
                f"the machine {host} of the cluster does not see the file {largest}, and it cannot be sent there: "
                f"the files of a task may have {megabytes(MOST_BYTES):.0f} MB, these have "
                f"{megabytes(size_bytes):.0f} MB",
                where=f"{host}:{largest}",
                remedy=REMEDY,
            )

    def _key(self, needed: NeededFile) -> str:
        words = (self._topic, needed.path, needed.size_bytes, needed.inode, needed.changed_ns)
        return hashlib.sha256("\0".join(map(str, words)).encode()).hexdigest()[:32]

    def _use(self, key: str, needed: NeededFile) -> None:
        """Note that a task uses a file, and ask for it if it is not here; called with the lock."""
        held = _held.pop(key, None)
        if held is None:
            folder = (self.folder / "sent" / key).resolve()
            folder.mkdir(parents=True, exist_ok=True)
            held = _Held(needed, self._topic, folder / Path(needed.path).name)
        _held[key] = held
        held.users += 1
        if not held.complete and held.users == 1:
            self._ask(key, held)

    def _ask(self, key: str, held: _Held) -> None:
        held.news_s = time.monotonic()
        request = {"worker": self._worker.address, "key": key, "file": dataclasses.asdict(held.needed)}
        self._worker.log_event(self._topic, request)

    def _wait_for(self, key: str) -> None:
        """Wait until a file is here. Raises DataError if it does not come."""
        with _news:
            held, wanted = _held[key], True
            while wanted and not held.complete and not held.problem:
                _news.wait(_LOOK_S)
                wanted = self._wanted()
                if time.monotonic() - held.news_s > _ASK_AGAIN_S:
                    self._ask(key, held)
            if not held.complete or held.problem:
                host = this_place().host
                raise DataError(
                    f"the machine {host} of the cluster does not see the file {held.needed.path}, and it cannot be "
                    f"sent there: {held.problem or 'the task is not wanted any more'}",
                    where=f"{host}:{held.needed.path}",
                    remedy=REMEDY,
                )

    def _wanted(self) -> bool:
        """Return whether anybody still wants the task: its client may have gone, or the worker may be ending."""
        task = self._worker.state.tasks.get(self._task_key)
        return self._worker.status.name == "running" and task is not None and task.state == "executing"

    def _leave(self, keys: Sequence[str]) -> None:
        """Note that a task has used files; remove what did not come, and beyond the limit what was unused longest."""
        for key in keys:
            _held[key].users -= 1
        for key in [key for key in keys if not _held[key].users and (_held[key].problem or not _held[key].complete)]:
            _remove(key)
        size_bytes = sum(held.needed.size_bytes for held in _held.values())
        for key in [key for key, held in _held.items() if not held.users]:
            if size_bytes <= _MOST_HELD_BYTES:
                return
            size_bytes -= _held[key].needed.size_bytes
            _remove(key)
