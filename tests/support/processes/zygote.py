"""The process from which those of the tests are forked: it has imported what they need, and never starts a thread.

`python -m tests.support.processes.zygote FD` serves requests on a Unix socket until its other end is closed, so that
it cannot outlive the tests. `tests.support.processes.forked` is the other end. A request forks a child that is the
same as a fresh `python -m MODULE WORDS…` or `orthocapture WORDS…`: it leaves this module by returning from it, runs
the program as `__main__`, and the interpreter ends it as any other: exit status, tracebacks, `atexit` and all. What
differs from a fresh process: modules are loaded already, `ps` shows the command line of the zygote, all children of
one zygote share the seed of `hash()`, passwords are hashed at the least cost, a protocol has been read and the
installed packages have been searched, and freed memory stays in the process.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import gc
import importlib
import io
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from typing import Any, Literal, TextIO

from tests.support.processes.memory import spend_memory_rather_than_time
from tests.support.processes.quick_hashes import hash_quickly

COMMANDS, SIMULATORS, HOST = "service.cli.main", "simulators", "drivers.host"
# What the pages start: modules of the program, each with those that it imports only once it needs them.
OF_PAGES = {
    "service.audit.exports": ("service.audit.data_set_export",),
    "service.audit.export_process": (
        "service.audit.data_set_export",
        "service.audit.report",
        "service.audit.report_output",
        "service.audit.report_output",
    ),
    "service.audit.verifications": (),
    "service.web.preview_process": ("service.audit.recorded_run", "service.dataset.preview"),
}
VENDORS = tuple(f"tests.support.vendor.{name}" for name in (
    "camera_vendor_session", "ur_vendor_session", "ur_vendor_calls",
))  # fmt: skip
CLUSTER = ("distributed.cli.dask_scheduler", "distributed.cli.dask_worker")
OF_TESTS = ("tests.support.processes.stubborn_program", "tests.support.processes.probe", *VENDORS, *CLUSTER)
_REQUEST_BYTES, _NUMBER_BYTES = 8, 8  # lengths of a request's size, and of a process id or an exit status
_STANDARD = (0, 1, 2)
_statuses: list[int] = []  # of this process, if it is a fork that has come to its end
MOST_PASSED = 4  # descriptors that a process may get besides those
_RIG = "rig"  # the simulator that starts others
_DESCRIBE = "--describe"  # asks for the options of the simulator that is named next
# Commands that start drivers, workers and runners, and the commands that these are.
_STARTING = ("run", "resume", "serve", "import", "doctor")
_STARTED = ("worker", "resume")
_LATE = ("simulators.rendering.render",)  # what simulators import only once they need it
_DRIVERS = (  # and what they import only once they are opened
    "drivers.gphoto.camera", "drivers.ur.robot", "drivers.ur.vendor", "drivers.grbl.table", "drivers.kuka.robot",
    "drivers.video", "drivers.host.serving", "scipy.optimize", "scipy.spatial.transform",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Request:
    """One process to start."""

    script: str  # the command as it is installed; "": `python -m MODULE`
    module: str
    words: list[str]
    cwd: str
    env: dict[str, str]
    session: bool  # whether it leads a session of its own
    passed: list[int]  # descriptors that it gets besides the standard ones, under these numbers

    @property
    def is_rig(self) -> bool:
        """Return whether it starts simulators itself."""
        return self.module == SIMULATORS and self.words[:1] == [_RIG]

    @property
    def starts_others(self) -> bool:
        """Return whether it starts processes that can be forked."""
        return self.is_rig or (self.module == COMMANDS and "".join(self.words[:1]) in _STARTING)

    @property
    def main(self) -> str:
        """The module that will run as `__main__`."""
        return f"{self.module}.__main__" if self.module in (SIMULATORS, HOST) else self.module


@dataclass
class _Zygote:
    """Forks children as it is asked to, and tells how each of them ended. Keeps plain descriptors, for the child."""

    control: int
    environment: dict[str, str]  # as it was when this process began
    prepared: set[tuple[str, ...]] = field(default_factory=set[tuple[str, ...]])  # kinds of processes
    ends_children: bool = True  # at its end; otherwise they go on, as those of a program do
    children: dict[int, tuple[int, int]] = field(default_factory=dict[int, tuple[int, int]])  # pidfd: pid, to tell

    def serve(self) -> _Request | None:
        """Serve until the other end is closed, and return None. Return a request in the child that is to run it."""
        poll = select.poll()
        poll.register(self.control, select.POLLIN)
        while True:
            for ready, _event in poll.poll():
                if ready != self.control:
                    poll.unregister(ready)
                    self._tell(ready)
                    continue
                told, request, descriptors = self._receive()
                if request is None:
                    if self.ends_children:
                        self._end()
                    return None
                self._prepare(request)
                pid = os.fork()
                if pid == 0:
                    _become(request, descriptors, self.environment)
                    return request
                for descriptor in descriptors:
                    os.close(descriptor)
                pidfd = os.pidfd_open(pid)
                self.children[pidfd] = (pid, told)
                poll.register(pidfd, select.POLLIN)
                _write(told, pid)

    def _receive(self) -> tuple[int, _Request | None, tuple[int, ...]]:
        """A request, where its answers go, and its stdin, stdout, stderr and others; None at the end of all."""
        control = socket.socket(fileno=os.dup(self.control))
        with control:
            data, descriptors, _flags, _address = socket.recv_fds(control, 1, 1 + len(_STANDARD) + MOST_PASSED)
        if not data:
            return -1, None, ()
        told, *its_own = descriptors
        size = int.from_bytes(_read(told, _REQUEST_BYTES), "little")
        return told, _Request(**json.loads(_read(told, size))), tuple(its_own)

    def _prepare(self, request: _Request) -> None:
        """Import what the process needs, unless it was done for one like it; no thread may begin by that."""
        described = request.words[:1] == [_DESCRIBE]
        alike = request.module in (HOST, *VENDORS)
        kind = (request.module, *([] if alike else request.words[: 2 if described else 1]))
        if kind in self.prepared:
            return
        self.prepared.add(kind)
        main: Any = importlib.import_module(request.main)
        word = kind[-1] if request.words else ""
        if request.module == SIMULATORS:
            known: dict[str, tuple[str, str]] = main.simulators()
            names = known if request.is_rig else {word} & known.keys()
            self.prepared.update((SIMULATORS, name) for name in names)
            needed = [*(known[name][0] for name in names), *(_LATE if names else ())]
        elif request.module == COMMANDS:  # it imports the module of a command on demand
            commands = vars(main)["_COMMANDS"]
            names = {word, *_STARTED} if request.starts_others else {word}
            needed = [commands[name].place.partition(":")[0] for name in sorted(names) if name in commands]
            if request.starts_others:
                self.prepared.update({(HOST,), *((COMMANDS, name) for name in _STARTED)})
                needed += [f"{HOST}.__main__", *_DRIVERS]
        elif request.module == HOST:  # it is told its driver later
            needed = list(_DRIVERS)
        else:
            needed = OF_PAGES.get(request.module, ())
        for name in needed:
            with contextlib.suppress(ModuleNotFoundError):  # the library of a device may not be installed
                importlib.import_module(name)
        hash_quickly()
        _do_once_for_all()
        assert len(os.listdir("/proc/self/task")) == 1, f"importing for {kind} started a thread"
        gc.collect()
        gc.freeze()  # the children's collections leave alone, and so share, what is here

    def _tell(self, pidfd: int) -> None:
        """Tell how a child has ended."""
        pid, told = self.children.pop(pidfd)
        _, status = os.waitpid(pid, 0)
        os.close(pidfd)
        try:
            _write(told, os.waitstatus_to_exitcode(status))
        except OSError:  # nobody wants to know
            pass
        finally:
            os.close(told)

    def _end(self) -> None:
        """Terminate what still runs: the tests are no more."""
        for pidfd in self.children:
            signal.pidfd_send_signal(pidfd, signal.SIGTERM)


def _do_once_for_all() -> None:
    """Do what most children would do first, as far as they import what it takes."""
    if "service.core.loading" in sys.modules:
        sys.modules["service.core.loading"].plug_ins("")  # searches the installed packages
    if "service.core.protocol" in sys.modules and "service.store.events" in sys.modules:
        importlib.import_module("tests.support.processes.first_reading").read_once()
    if "service.web.rendering" in sys.modules:
        importlib.import_module("tests.support.pages.compiled_templates").keep_compiled_templates()


def _changed(before: dict[str, str]) -> dict[str, str]:
    """The variables that libraries have set while they were imported, as they do in every process."""
    return {name: value for name, value in os.environ.items() if before.get(name) != value}


def _become(request: _Request, descriptors: tuple[int, ...], before: dict[str, str]) -> None:
    """Turn this fork into the process that was asked for, but for its main module.

    `descriptors`: its standard ones and those passed. `before`: the environment when the zygote began.
    """
    from_imports = _changed(before)
    if request.session:
        os.setsid()
    numbers = (*_STANDARD, *request.passed)
    highest = max(*map(int, os.listdir("/proc/self/fd")), *numbers)
    moved = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, highest + 1) for descriptor in descriptors]  # out of the way
    os.closerange(len(_STANDARD), highest + 1)
    for number, descriptor in zip(numbers, moved, strict=True):
        os.dup2(descriptor, number)
    os.closerange(highest + 1, max(moved) + 1)
    os.chdir(request.cwd)
    os.environ.clear()
    os.environ.update(request.env | from_imports)
    time.tzset()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    others = [place for place in sys.path[1:] if place not in _listed(before)]
    sys.path[:] = [os.path.dirname(request.script) or request.cwd, *_listed(request.env), *others]
    sys.argv = [request.script or request.main, *request.words]
    _open_standard_streams(unbuffered=bool(request.env.get("PYTHONUNBUFFERED")))
    if "cv2" in sys.modules and request.env.get("OPENCV_LOG_LEVEL") == "SILENT":
        logging = sys.modules["cv2"].utils.logging
        logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    if "numpy" in sys.modules:
        sys.modules["numpy"].random.seed()  # Python's own was seeded anew by fork
    if "multiprocessing.process" in sys.modules:
        vars(sys.modules["multiprocessing.process"])["ORIGINAL_DIR"] = request.cwd  # where it starts further ones
    parent, _, name = request.main.rpartition(".")
    if sys.modules.pop(request.main, None) is not None:  # as if it was never imported
        delattr(sys.modules[parent], name)


def _listed(environment: dict[str, str]) -> list[str]:
    """Where modules are looked for by the environment."""
    return [place for place in environment.get("PYTHONPATH", "").split(os.pathsep) if place]


def _open_standard_streams(*, unbuffered: bool) -> None:
    """Open `sys.stdin`, `sys.stdout` and `sys.stderr` as the interpreter does at its start."""

    def opened(before: TextIO, descriptor: int, mode: Literal["rb", "wb"]) -> TextIO:
        assert isinstance(before, io.TextIOWrapper)
        binary = open(descriptor, mode, 0 if unbuffered and mode == "wb" else -1, closefd=False)  # noqa: SIM115
        lines = not unbuffered and (descriptor == _STANDARD[2] or os.isatty(descriptor))
        return io.TextIOWrapper(
            binary, before.encoding, before.errors, newline="\n", line_buffering=lines, write_through=unbuffered
        )

    sys.stdin = sys.__stdin__ = opened(sys.stdin, 0, "rb")
    sys.stdout = sys.__stdout__ = opened(sys.stdout, 1, "wb")
    sys.stderr = sys.__stderr__ = opened(sys.stderr, 2, "wb")


def _read(descriptor: int, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = os.read(descriptor, size - len(data))
        assert part, "the request ended too early"
        data += part
    return data


def _write(descriptor: int, number: int) -> None:
    os.write(descriptor, number.to_bytes(_NUMBER_BYTES, "little", signed=True))


def _below(zygote: _Zygote, asked: _Request) -> tuple[_Request | None, bool]:
    """Let this process fork what it starts from a zygote of its own, which is forked before any thread is.

    Returns twice: the process's own request, and in each fork of that zygote its request, with whether this is such a
    fork. None is that zygote's end.
    """
    ours, theirs = socket.socketpair()
    pid = os.fork()
    if pid == 0:
        ours.close()
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with open(os.devnull, "r+b") as nowhere:  # not the rig's, whose end its reader waits for
            for descriptor in _STANDARD[:2]:
                os.dup2(nowhere.fileno(), descriptor)
        below = _Zygote(theirs.detach(), asked.env, zygote.prepared, ends_children=asked.is_rig)
        return below.serve(), True
    theirs.close()
    forked: Any = importlib.import_module("tests.support.processes.forked")
    forked.use(ours, pid)
    _use_forks(forked.Forked)
    return asked, False


def _use_forks(forked: type[subprocess.Popen[Any]]) -> None:
    """Let this process start others by forks, also by modules that have imported `Popen` already."""
    started = subprocess.Popen
    subprocess.Popen = forked  # pyright: ignore[reportAttributeAccessIssue]
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in ("service", "drivers", "simulators") and vars(module).get("Popen") is started:
            vars(module)["Popen"] = forked


def _leave_at_once() -> None:
    """End this fork once all is done, unless it failed: to take the modules apart would copy all of their memory."""
    if _statuses:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        except (OSError, ValueError):  # the interpreter has a status of its own for this
            return
        os._exit(_statuses[-1])


if __name__ == "__main__":
    atexit.register(_leave_at_once)  # before all others, so that it is called after them
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the tests, and they end this
    spend_memory_rather_than_time()
    _of_tests = _Zygote(int(sys.argv[1]), dict(os.environ))
    _asked = _of_tests.serve()
    _fresh = True  # whether it is a fork that has no zygote of its own yet
    while _fresh and _asked is not None and _asked.starts_others:
        _asked, _fresh = _below(_of_tests, _asked)
    try:
        if _asked is not None and _asked.script:
            runpy.run_path(_asked.script, run_name="__main__")
        elif _asked is not None:
            runpy.run_module(_asked.module, run_name="__main__", alter_sys=True)
    except SystemExit as _ended:
        if _ended.code is None or isinstance(_ended.code, int):
            _statuses.append((_ended.code or 0) & 0xFF)
        raise
    else:
        _statuses.append(0)
