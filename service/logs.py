"""Logs of the runner, worker, web server and drivers as JSON lines, for finding causes; they are not evidence.

A file is rotated by size and bounded in total, secrets are removed from its lines, and each line says what the
process worked on when it was written. The output of libraries stays off the terminal, so that people read there
only what this program says; their records still reach the files, from warnings up. With ORTHOCAPTURE_LIBRARY_WORDS=1
in the environment, everything appears on the terminal too.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import logging
import os
import platform
import re
import shutil
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from os import getpid
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from service.core.units import gigabytes
from service.core.words import shown_continued

if TYPE_CHECKING:
    from structlog.typing import EventDict, WrappedLogger

ASKED = "ORTHOCAPTURE_LIBRARY_WORDS"
_OURS = frozenset({"service", "drivers", "simulators", "orthocapture", "root"})
_QUIET = {  # what native libraries read when they are loaded, here and in every child process
    "OPENCV_LOG_LEVEL": "SILENT",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
}
_open_files: list[int] = []  # what C writes to instead of the terminal; it must outlive every library


def show_own_words_only() -> None:
    """Show only the log records of this program from now on, and nothing of what native libraries print.

    It comes before libraries are imported, and holds for those too whose import sets the level of their loggers, as
    pydicom's does. What Python writes to the error stream stays: tracebacks, and the output of child processes.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(EscapingFormatter("%(asctime)s %(name)s %(levelname)s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.captureWarnings(capture=True)
    if os.environ.get(ASKED):
        return
    handler.addFilter(is_own)
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    _divert_stdio()


class EscapingFormatter(logging.Formatter):
    """Lines in which nothing is left that a terminal would obey: messages may quote a device or a file."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one record as lines."""
        return shown_continued(super().format(record))


def is_own(record: logging.LogRecord) -> bool:
    """Return whether a record is of this program, not of a library."""
    return record.name.partition(".")[0] in _OURS


def _divert_stdio() -> None:
    """Let C's `stderr` lead nowhere: libjpeg and libpng print there, and offer no switch through OpenCV.

    Only the variable of the C library is set, so descriptor 2, which Python and child processes write to, stays as it
    is. Other C libraries than glibc may keep the variable in memory that cannot be written.
    """
    if platform.libc_ver()[0] != "glibc" or _open_files:
        return
    libc = ctypes.CDLL(None)
    libc.fopen.restype = ctypes.c_void_p
    nowhere = libc.fopen(os.devnull.encode(), b"w")
    if nowhere:
        _open_files.append(nowhere)
        ctypes.c_void_p.in_dll(libc, "stderr").value = nowhere


_LONGEST = 20_000  # characters of one text: the traceback of a deep recursion must not rotate the whole log away
_OUR_LOGGERS = ("service", "drivers", "orthocapture")  # other libraries log too much below warnings
_CHILDREN = "drivers.host."  # loggers with which drivers.host passes on what a driver's process logs


@contextmanager
def file_log(
    data: Path,
    process: str,
    *,
    run: str = "",
    handler: BoundedFile | None = None,
    admits: Callable[[logging.LogRecord], bool] | None = None,
) -> Generator[None]:
    """Also write log records to `data`/logs in this block: ours from INFO up, other libraries' from WARNING up.

    Args:
        data: the data folder; nothing is written until it exists.
        process: name written in every line: runner, worker, web …
        run: run id, also written in every line.
        handler: replaces the data folder's file.
        admits: decides for each record whether it is written; None: all are.
    """
    handler = handler or BoundedFile(data)
    handler.setFormatter(_formatter(process))
    if admits is not None:
        handler.addFilter(admits)
    root = logging.getLogger()
    before = root.level
    # The root level chose what the terminal shows; keep that choice on its handlers, since ours needs INFO.
    shown = [other for other in root.handlers if other.level < before]
    levels = [other.level for other in shown]
    for other in shown:
        other.setLevel(before)
    ours = [logging.getLogger(name) for name in _OUR_LOGGERS]
    levels_of_ours = [logger.level for logger in ours]
    for logger in ours:
        logger.setLevel(min(before, logging.INFO))
    root.addHandler(handler)
    at(run=run)
    try:
        yield
    finally:
        at(run="", step="", viewpoint="", job="")
        root.removeHandler(handler)
        for logger, level in zip(ours, levels_of_ours, strict=True):
            logger.setLevel(level)
        for other, level in zip(shown, levels, strict=True):
            other.setLevel(level)
        handler.close()


def _formatter(process: str) -> logging.Formatter:
    import structlog  # noqa: PLC0415 - steps that say where they work need no log

    def place(_logger: WrappedLogger, _method: str, line: EventDict) -> EventDict:
        name = str(line.get("logger", ""))
        child = name.removeprefix(_CHILDREN) if name.startswith(_CHILDREN) else ""
        whose = {"process": f"driver {child}" if child else process, "pid": getpid()}
        return {**where_now(), **line, **whose}

    return structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[
            structlog.stdlib.add_log_level,
            structlog.stdlib.add_logger_name,
            structlog.stdlib.ExtraAdder(),
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="at_utc"),
            place,
        ],
        processors=[
            structlog.stdlib.ProcessorFormatter.remove_processors_meta,
            structlog.processors.format_exc_info,  # leaves out the values of variables
            _shortened,
            _scrubbed,
            structlog.processors.JSONRenderer(ensure_ascii=False),
        ],
    )


def _shortened(_logger: WrappedLogger, _method: str, line: EventDict) -> EventDict:
    return {
        name: value[:_LONGEST] + " …" if isinstance(value, str) and len(value) > _LONGEST else value
        for name, value in line.items()
    }


def _scrubbed(_logger: WrappedLogger, _method: str, line: EventDict) -> EventDict:
    return {name: without_secrets(value, name) for name, value in line.items()}


LOG_NAME = "orthocapture.jsonl"
FILE_BYTES = 10_000_000
FILES = 10  # the current file and the older ones: 100 MB in total
_STOPPED = "less than {:.1f} GB are free: logging stops until there is more; the evidence is still recorded"
_GOES_ON = "logging resumes: there is space again"


class BoundedFile(logging.Handler):
    """Writes lines to DATA/logs/orthocapture.jsonl; older ones move to orthocapture.1.jsonl, .2 …, then go.

    A failure here never disturbs the process that logs: a line that cannot be written is lost.
    """

    def __init__(
        self,
        data: Path,
        *,
        file_bytes: int = FILE_BYTES,
        files: int = FILES,
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        super().__init__(logging.INFO)
        from service.core.disk_space import LEAST_FREE_BYTES  # noqa: PLC0415 - the terminal needs none of it

        self._data = data
        self._least_free_bytes = LEAST_FREE_BYTES
        self._file_bytes, self._files = file_bytes, files
        self._free_bytes = free_bytes
        self._stream: BinaryIO | None = None
        self._stopped = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record as a line; rotate the files first if it does not fit. `logging.Handler` holds its lock."""
        if not self._data.is_dir():
            return  # no data folder yet, and a log must not create one
        with contextlib.suppress(OSError):
            full = self._free_bytes(self._data) < self._least_free_bytes
            if full and self._stopped:
                return
            if full != self._stopped:
                self._write(
                    self._line(record, _STOPPED.format(gigabytes(self._least_free_bytes)) if full else _GOES_ON)
                )
                self._stopped = full
            if not full:
                self._write(self._line(record))

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        super().close()

    def _line(self, record: logging.LogRecord, instead: str = "") -> bytes:
        if instead:
            record = logging.LogRecord(__name__, logging.WARNING, __file__, 0, instead, None, None)
        return self.format(record).encode(errors="backslashreplace") + b"\n"

    def _write(self, line: bytes) -> None:
        folder = self._data / "logs"
        folder.mkdir(exist_ok=True)
        with _locked(folder / ".lock"):
            path = folder / LOG_NAME
            if self._stream is not None and not _is(self._stream, path):  # another process has rotated
                self._stream.close()
                self._stream = None
            if self._stream is None:
                self._stream = path.open("ab", buffering=0)
            size = os.fstat(self._stream.fileno()).st_size  # other processes append too
            if size and size + len(line) > self._file_bytes:
                self._stream.close()
                self._rotate(path)
                self._stream = path.open("ab", buffering=0)
            self._stream.write(line)

    def _rotate(self, path: Path) -> None:
        for number in range(self._files - 1, 0, -1):
            older = path.with_suffix(f".{number}.jsonl")
            newer = path if number == 1 else path.with_suffix(f".{number - 1}.jsonl")
            if newer.exists():
                newer.replace(older)


@contextlib.contextmanager
def _locked(path: Path) -> Generator[None]:
    with path.open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _is(stream: BinaryIO, path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        here, there = os.fstat(stream.fileno()), path.stat()
        return (here.st_dev, here.st_ino) == (there.st_dev, there.st_ino)
    return False


OUT = "[secret]"
_NAMES = r"pass(?:word|phrase|wd)?|pin|token|csrf|secret|authorization|cookie|api[_-]?key|private[_-]?key|session"
_NAME = re.compile(rf"(?:\w*_)?(?:{_NAMES})(?:_hash|_sha256)?", re.IGNORECASE)
_PATTERNS = (
    (re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|\Z)", re.DOTALL), OUT),
    (re.compile(r"(/set-up/)[^\s\"'<>/?#{]+"), rf"\1{OUT}"),
    (re.compile(r"(://)[^/\s:@]+:[^/\s@]+@"), rf"\1{OUT}@"),
    (re.compile(r"\$argon2\S+"), OUT),
    # Authorization: Bearer abc; Cookie: a=b; c=d
    (re.compile(r"\b(authorization|(?:set-)?cookie)(\s*[:=]\s*)[^\r\n]+", re.IGNORECASE), rf"\1\2{OUT}"),
    (
        re.compile(rf"\b((?:\w*_)?(?:{_NAMES}))(['\"]?\s*[=:]\s*)(\"[^\"]*\"|'[^']*'|[^\s,;&)}}\]]+)", re.IGNORECASE),
        rf"\1\2{OUT}",
    ),
)


def without_secrets(value: Any, name: str = "") -> Any:
    """Return a copy of plain data with secrets replaced by `[secret]`, found by field name and by pattern in text."""
    if name and _NAME.fullmatch(name) and value not in (None, "", False, True):
        return OUT
    if isinstance(value, str):
        for pattern, instead in _PATTERNS:
            value = pattern.sub(instead, value)
        return value
    if isinstance(value, Mapping):
        return {str(key): without_secrets(item, str(key)) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_secrets(item) for item in value]
    return value


# What this process works on now (run, step, viewpoint), added to every log line whichever thread writes it.
#
# It belongs to the process, not to a thread: one process drives one run or computes one job, and its drivers answer
# in threads of their own.


_now: Mapping[str, str] = {}


def at(**names: str) -> None:
    """Set names for all later lines, as in `at(step="capture", viewpoint="v1_003")`; "" removes a name."""
    global _now  # noqa: PLW0603 - one per process (see above); replaced as a whole, so no thread sees half of it
    _now = {name: value for name, value in {**_now, **names}.items() if value}


def where_now() -> Mapping[str, str]:
    """Return the names that are set now."""
    return _now
