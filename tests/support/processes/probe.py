"""A program that tells what it finds in its process, and ends as its argument says: to compare how it was started."""

from __future__ import annotations

import atexit
import json
import os
import random
import signal
import stat
import sys
import threading
import time
from typing import TextIO

import numpy as np


def found() -> dict[str, object]:
    """What a program can see of how it was started, but for what differs each time."""
    streams = (sys.stdin, sys.stdout, sys.stderr)
    return {
        "name": __name__,
        "spec": getattr(__spec__, "name", ""),
        "main": sys.modules["__main__"].__dict__ is globals(),
        "argv": sys.argv,
        "path": sys.path,
        "cwd": os.getcwd(),
        "environment": dict(os.environ),
        "streams": [_of_stream(stream) for stream in streams],
        "handlers": {number.name: str(signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)},
        "pipe": str(signal.getsignal(signal.SIGPIPE)),
        "blocked": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])),
        "files": sorted(map(_of_file, os.listdir("/proc/self/fd"))),
        "threads": [thread.name for thread in threading.enumerate()],
        "leads": os.getsid(0) == os.getpid(),
        "zone": time.tzname,
    }


def drawn() -> list[object]:
    """What differs each time."""
    return [os.getpid(), random.random(), float(np.random.random())]


def _of_stream(stream: TextIO) -> list[object]:
    buffering = (getattr(stream, "line_buffering", None), getattr(stream, "write_through", None))
    return [stream.fileno(), stream.encoding, stream.errors, *buffering, type(stream.buffer).__name__]


def _of_file(descriptor: str) -> str:
    """Number and kind of an open file; nothing for that of the list itself, which is closed by now."""
    try:
        mode = os.fstat(int(descriptor)).st_mode
    except OSError:
        return ""
    return f"{descriptor} {stat.filemode(mode)}"


def main(how: str) -> None:
    """End so."""
    sys.stdout.write(json.dumps({"found": found(), "drawn": drawn(), "typed": sys.stdin.read()}) + "\n")
    atexit.register(sys.stdout.write, "at exit")
    if how == "raise":
        raise ValueError("it was asked for")
    if how == "interrupt":
        raise KeyboardInterrupt
    if how == "words":
        sys.exit("in words")
    if how == "thread":  # a process waits for it
        threading.Timer(0.1, lambda: sys.stdout.write("a thread, ")).start()
    if how == "abort":
        sys.stdout.flush()
        os.abort()
    if how == "broken":  # nobody reads on
        sys.stdout.close()
    if how.isdigit():
        sys.exit(int(how))


if __name__ == "__main__":
    main(sys.argv[1])
