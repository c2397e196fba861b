"""Starts processes of the program for tests without importing everything again: by forks of a zygote.

`Forked` and `run` stand for `subprocess.Popen` and `subprocess.run`. What is forked: `orthocapture …`,
`python -m service.cli.main …`, `python -m simulators …`, `python -m drivers.host …`, some programs of the tests and
those of a Dask cluster (OF_TESTS); the devices that a forked rig starts; the drivers, workers and runners that a
forked command starts; and what the pages of a site in this process start for exports, previews and verifications
(OF_PAGES, by `pages_fork`). Everything else is a real start, as are these where the environment differs in a variable
that something may read while it starts.

What is about starting itself is a real start too, by `subprocess`: tests/cli/test_start_up.py, the installed command
in tests/cli, the package in tests/system, the tree of a rig's processes in tests/rig/test_rig.py, `python -I`. So are
the children in which a worker computes, and the drivers that a test opens in its own process without asking for forks
(tests/support/processes/hosts.py).
"""

from __future__ import annotations

import atexit
import json
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, AnyStr, cast
from unittest.mock import patch

from service.audit import background
from tests.support.processes.zygote import COMMANDS, HOST, MOST_PASSED, OF_PAGES, OF_TESTS, SIMULATORS

ROOT = Path(__file__).resolve().parents[3]
INSTALLED = Path(sys.executable).with_name("orthocapture")
_ZYGOTE = "tests.support.processes.zygote"
_MODULES = (COMMANDS, SIMULATORS, HOST, *OF_PAGES, *OF_TESTS)
# Variables that begin so decide nothing while a process starts, or are set by it: by libraries when they are imported
# (cv2, gdcm, gphoto2, torch), and by drivers that tests use in their own process.
SET_BY_IMPORTS = ("LD_LIBRARY_PATH", "GDCM_RESOURCES_PATH", "CAMLIBS", "IOLIBS", "TORCHINDUCTOR_CACHE_DIR")
_READ_LATER = ("ORTHOCAPTURE_", "PYTEST_", "GENTL_CAMERA", "OPENCV_FFMPEG_", "XDG_CONFIG_HOME", *SET_BY_IMPORTS)
# What the zygote does in the place of the interpreter, and of OpenCV: each command silences that for what it starts.
_DONE_BY_ZYGOTE = ("PYTHONPATH", "PYTHONUNBUFFERED", "OPENCV_LOG_LEVEL")
_ENVIRONMENT = dict(os.environ)  # before any test has changed it
_NUMBER_BYTES = 8
_PARENT = "--parent"


class _Parent:
    """The zygote of this process, started when it is first needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._pid = 0

    def start(self, request: dict[str, Any], descriptors: Sequence[int]) -> tuple[int, socket.socket]:
        """Fork a process; returns its id, and what will tell its exit status."""
        ours, theirs = socket.socketpair()
        try:
            with self._lock, theirs:
                control, pid = self._begun()
                socket.send_fds(control, [b"+"], [theirs.fileno(), *descriptors])
            words = request["words"]
            request["words"] = [str(pid) if _states_parent(words, at) else word for at, word in enumerate(words)]
            data = json.dumps(request).encode()
            ours.sendall(len(data).to_bytes(_NUMBER_BYTES, "little") + data)
            return _number(ours), ours
        except BaseException:
            ours.close()
            raise

    def end(self) -> None:
        """End the zygote."""
        with self._lock:
            if self._control is not None:
                self._control.close()
            if self._process is not None:
                self._process.wait(timeout=30)
            elif self._pid:
                os.waitpid(self._pid, 0)
            self._control = self._process = None

    def use(self, control: socket.socket, pid: int) -> None:
        """Use a zygote that was forked from this process."""
        self._control, self._pid = control, pid
        atexit.register(self.end)

    def _begun(self) -> tuple[socket.socket, int]:
        """Its control socket and process id; starts it if it is not there yet."""
        if self._control is None:
            self._control, theirs = socket.socketpair()
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", _ZYGOTE, str(theirs.fileno())], cwd=ROOT, env=_ENVIRONMENT,
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, pass_fds=[theirs.fileno()],
                )  # fmt: skip
            self._pid = self._process.pid
            atexit.register(self.end)
        return self._control, self._pid


_PARENT_OF_ALL = _Parent()
use = _PARENT_OF_ALL.use


class Forked(subprocess.Popen[AnyStr]):
    """A `subprocess.Popen` whose process is forked from the zygote, if it can be."""

    _news: socket.socket | None = None  # tells the exit status; None: it is a real start
    _reading = threading.Lock()

    @property
    def is_fork(self) -> bool:
        """Return whether it is a fork, rather than a real start."""
        return self._news is not None

    def poll(self) -> int | None:
        """The exit status, or None while it runs."""
        return super().poll() if self._news is None else self._told(0)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end. Raises TimeoutExpired."""
        if self._news is None:
            return super().wait(timeout)
        status = self._told(timeout)
        if status is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return status

    def _told(self, timeout_s: float | None) -> int | None:
        news = self._news
        descriptor = -1 if news is None else news.fileno()
        if self.returncode is None and news is not None and descriptor >= 0:
            poll = select.poll()
            poll.register(descriptor, select.POLLIN)
            if poll.poll(None if timeout_s is None else 1e3 * max(0.0, timeout_s)):
                with Forked._reading:
                    if self.returncode is None:  # pyright: ignore[reportUnnecessaryComparison] - of another thread
                        with news:
                            self.returncode = _number(news)
        return self.returncode

    def _execute_child(
        self,
        args: Any,
        executable: Any,
        preexec_fn: Any,
        close_fds: bool,
        pass_fds: Any,
        cwd: Any,
        env: Mapping[str, str] | None,
        startupinfo: Any,
        creationflags: int,
        shell: bool,
        p2cread: int,
        p2cwrite: int,
        c2pread: int,
        c2pwrite: int,
        errread: int,
        errwrite: int,
        restore_signals: bool,
        gid: Any,
        gids: Any,
        uid: Any,
        umask: int,
        start_new_session: bool,
        process_group: int,
    ) -> None:
        """Start the process: the one method in which `subprocess.Popen` of Python 3.11 to 3.13 does so."""
        environment = dict(os.environ if env is None else env)
        folder = os.fspath(cwd or Path.cwd())
        passed: list[int] = sorted(map(int, pass_fds))
        plain = close_fds and not (preexec_fn or shell or executable or not restore_signals)
        plain = plain and len(passed) <= MOST_PASSED
        plain = plain and (gid, gids, uid, umask, process_group) == (None, None, None, -1, -1)
        started = _of_the_program(args)
        if not (plain and started and Path(folder).is_dir() and _at_start(environment) == _at_start(_ENVIRONMENT)):
            super()._execute_child(  # pyright: ignore[reportAttributeAccessIssue]
                args, executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell,
                p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite, restore_signals, gid, gids, uid, umask,
                start_new_session, process_group,
            )  # fmt: skip
            return
        request = {**started, "cwd": folder, "env": environment, "session": start_new_session, "passed": passed}
        standard = [own if own != -1 else ours for ours, own in enumerate((p2cread, c2pwrite, errwrite))]
        try:
            self.pid, self._news = _PARENT_OF_ALL.start(request, [*standard, *passed])
            self._child_created = True
        finally:
            self._close_pipe_fds(  # pyright: ignore[reportAttributeAccessIssue]
                p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite
            )


def run(
    words: Sequence[str],
    *,
    timeout_s: float,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    typed: str | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a process to its end, with its input and output as text. Raises TimeoutExpired."""
    stdin = subprocess.DEVNULL if typed is None else subprocess.PIPE
    pipes: dict[str, Any] = {"stdin": stdin, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Forked(words, cwd=cwd, env=env, text=True, **pipes) as process:
        try:
            stdout, stderr = process.communicate(typed, timeout_s)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)


@contextmanager
def pages_fork() -> Generator[None]:
    """Let what the pages of a site in this process start be forks, while the block lasts."""
    with patch.object(background, "subprocess", SimpleNamespace(**{**vars(subprocess), "Popen": Forked})):
        yield


def _of_the_program(words: object) -> dict[str, Any] | None:
    """What to run, if this is a command line of a main module that can be forked."""
    if not isinstance(words, list | tuple) or not _forks():
        return None
    match [str(word) for word in cast("Sequence[object]", words)]:
        case [program, "-m", module, *rest] if program == sys.executable and module in _MODULES:
            return {"script": "", "module": module, "words": rest}
        case [script, *rest] if script == str(INSTALLED):
            return {"script": script, "module": COMMANDS, "words": rest}
        case _:
            return None


def _forks() -> bool:
    """Say whether this machine can fork, and has one thread of linear algebra: the zygote must not have more."""
    return hasattr(os, "pidfd_open") and _ENVIRONMENT.get("OPENBLAS_NUM_THREADS") == "1"


def _at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that somebody may read while a process starts."""
    plain = {name: value for name, value in environment.items() if name not in _DONE_BY_ZYGOTE}
    return {name: value for name, value in plain.items() if not name.startswith(_READ_LATER)}


def _states_parent(words: Sequence[str], at: int) -> bool:
    """Return whether this word names this process as the parent, which for a fork is the zygote."""
    return at > 0 and words[at - 1] == _PARENT and words[at] == str(os.getpid())


def _number(told: socket.socket) -> int:
    data = told.recv(_NUMBER_BYTES, socket.MSG_WAITALL)
    if len(data) < _NUMBER_BYTES:
        raise RuntimeError("the zygote has ended, and told nothing of a process")
    return int.from_bytes(data, "little", signed=True)
