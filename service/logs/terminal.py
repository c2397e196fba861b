"""Keeps the output of libraries from the terminal, so that people read there only what this program says.

Records of libraries still reach the log files of the data folder, from warnings up. With ORTHOCAPTURE_LIBRARY_WORDS=1
in the environment, everything appears on the terminal too.
"""

from __future__ import annotations

import ctypes
import logging
import os
import platform

from service.core.words import shown_continued

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
