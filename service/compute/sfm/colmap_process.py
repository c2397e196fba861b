"""Runs COLMAP and reads its models in child processes, because it takes over signal handlers and may crash."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

from service.compute.sfm.options import Progress
from service.core.errors import ComputeError, DataError, OrthocaptureError
from service.core.geometry import Transform
from service.machine.executors import ChildEndedError, ChildLimits, call_in_child

_END_S = 1.0  # that an idle child may take to end itself


class ColmapProcess:
    """Runs tasks one after another in a child process, which starts with the first task and lives until `close`.

    Not thread-safe.
    """

    def __init__(self, *, seed: int, log: Path | None = None) -> None:
        """Write COLMAP's output to `log`; None: to a temporary file."""
        self._seed = seed
        self._temporary = log is None
        self._log = log
        self._end: weakref.finalize[[subprocess.Popen[bytes], Connection], Self] | None = None
        self._pipe: Connection | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    def run(self, task: str, job: dict[str, Any], *, timeout_s: float, progress: Progress | None = None) -> Any:
        """Run `task` (see `child`) on the job and return its result.

        Raises:
            ComputeError: COLMAP failed, crashed or took too long.
            OrthocaptureError: raised by the task itself.
        """
        try:
            answer = self._answer(task, job, time.monotonic() + timeout_s, progress)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            tail = self._tail()
            self.close()
            raise ComputeError(
                f"COLMAP crashed during {task}: {tail}", where=str(self._log), remedy="See its log"
            ) from None
        except BaseException:
            self.close()  # otherwise a late answer could be taken for the next task's
            raise
        if answer is None:
            self.close()
            raise ComputeError(f"COLMAP did not end {task} within {timeout_s:.0f} s", where=str(self._log))
        kind, value = answer
        if kind == "result":
            return value
        if isinstance(value, OrthocaptureError):
            raise value
        raise ComputeError(f"COLMAP failed during {task}: {value}", where=str(self._log), remedy="See its log")

    def _answer(
        self, task: str, job: dict[str, Any], deadline: float, progress: Progress | None
    ) -> tuple[str, Any] | None:
        """Return the child's answer to the task; None if it took too long."""
        pipe = self._started()
        pipe.send((task, job))
        while pipe.poll(max(0.0, deadline - time.monotonic())):
            kind, value = pipe.recv()
            if kind != "progress":
                return kind, value
            if progress is not None:
                progress(*value)
        return None

    def close(self) -> None:
        """End the child; the next task starts a new one."""
        if self._end is None:
            return
        self._end()
        self._end = self._pipe = None
        if self._temporary and self._log is not None:
            self._log.unlink(missing_ok=True)
            self._log = None

    def _started(self) -> Connection:
        if self._pipe is None:
            if self._log is None:
                handle, name = tempfile.mkstemp(prefix="orthocapture-colmap-", suffix=".log")
                os.close(handle)
                self._log = Path(name)
                weakref.finalize(self, self._log.unlink, missing_ok=True)  # in case nobody closes it
            self._pipe, theirs = Pipe()
            # A worker of a Dask cluster is a daemon of `multiprocessing`, which may have no children of that kind.
            process = subprocess.Popen(
                [sys.executable, "-m", "service.compute.sfm.child", str(self._log), str(self._seed),
                 str(theirs.fileno())],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(folder or str(Path.cwd()) for folder in sys.path)},
                stdin=subprocess.DEVNULL, pass_fds=(theirs.fileno(),),
            )  # fmt: skip
            theirs.close()
            self._end = weakref.finalize(self, _end_child, process, self._pipe)
        return self._pipe

    def _tail(self) -> str:
        assert self._log is not None
        try:
            lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except FileNotFoundError:
            return "no log"
        return " | ".join(lines[-3:]) if lines else "empty log"


def _end_child(process: subprocess.Popen[bytes], pipe: Connection) -> None:
    """Close the pipe, at which an idle child ends itself, and kill one that does not."""
    pipe.close()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class _ThreadProcesses(threading.local):
    """COLMAP's child process of each thread, by seed; it stays, because starting one takes as long as an image."""

    def __init__(self) -> None:
        self.by_seed: dict[int, ColmapProcess] = {}


_OF_THREAD = _ThreadProcesses()


def thread_process(seed: int) -> ColmapProcess:
    """Return the child process that this thread keeps from task to task."""
    return _OF_THREAD.by_seed.setdefault(seed, ColmapProcess(seed=seed))


def end_thread_process(seed: int) -> None:
    """End the child process that this thread keeps, if there is one."""
    process = _OF_THREAD.by_seed.pop(seed, None)
    if process is not None:
        process.close()


_SPARE_BYTES = 1 << 30  # beyond what the library itself needs
_SPARE_S, _BYTES_PER_S = 3.0, 1e6  # text is read sixty times as fast
_PER_BYTE = 40  # memory per byte of a model's files: an observation takes 24 bytes in a file and about 60 in memory


def read_model(folder: Path) -> dict[str, Transform]:
    """Read T_world_camera (4, 4) by image name from the model in `folder`.

    Raises:
        DataError: the model cannot be read.
    """
    return cast("dict[str, Transform]", _in_child(_read, folder, str(folder)))


def _in_child(work: Callable[..., Any], folder: Path, *arguments: object) -> object:
    """Call `work` with no more memory and time than an intact model of these files needs.

    Counts in a damaged file may request any amount.
    """
    files_bytes = sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    limits = ChildLimits(_SPARE_BYTES + _PER_BYTE * files_bytes, _SPARE_S + files_bytes / _BYTES_PER_S)
    try:
        outcome = call_in_child(work, *arguments, module="pycolmap", limits=limits)
    except ChildEndedError:
        outcome = "pycolmap crashed on it, or took far longer than a sound model takes"
    except MemoryError:
        outcome = "it announces more than memory can hold"
    if isinstance(outcome, str):
        raise DataError(
            f"the COLMAP model cannot be read: {outcome}",
            where=str(folder),
            remedy="Check that cameras, images and points3D belong together and are complete",
        )
    return outcome


def _read(folder: str) -> dict[str, Transform] | str:
    colmap = importlib.import_module("pycolmap")
    convention = importlib.import_module("service.compute.sfm.colmap")
    colmap.logging.minloglevel = colmap.logging.FATAL.value
    try:
        model = colmap.Reconstruction(folder)
        images = sorted((model.image(k) for k in model.reg_image_ids()), key=lambda image: image.name)
        return {image.name: convention.from_colmap_pose(image.cam_from_world()) for image in images}
    except UnicodeDecodeError:
        return "the name of an image is not UTF-8"
    except (RuntimeError, ValueError, IndexError, OSError) as error:  # everything that pycolmap raises
        return (str(error).strip().splitlines() or [type(error).__name__])[-1]
