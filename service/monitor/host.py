"""Measures how this machine does: how well its clock is synchronised, and how long threads waited for a processor."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys
import threading
import time

from drivers.machine_pressure import processor_time
from service.core.records.run_events import HostClock
from service.core.units import seconds_of_us

_SYSTEM_TIME = re.compile(r"^System time\s*:\s*([0-9.]+) seconds (fast|slow) of NTP time", re.MULTILINE)
_LEAP = re.compile(r"^Leap status\s*:\s*(.+?)\s*$", re.MULTILINE)
_TIMEOUT_S = 3.0
_STA_UNSYNC = 0x40
_NOT_SET_S = 16.0  # the kernel's value for an unknown error


def host_clock() -> HostClock:
    """Return the clock's state now; unknown values are None. Never raises."""
    return _of_chrony() or _of_kernel()


def _of_chrony() -> HostClock | None:
    program = shutil.which("chronyc")
    if program is None:
        return None
    try:
        done = subprocess.run(
            [program, "-n", "tracking"],
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=True,
            env={**os.environ, "LC_ALL": "C"},
        )
    except (OSError, subprocess.SubprocessError):
        return None
    found, leap = _SYSTEM_TIME.search(done.stdout), _LEAP.search(done.stdout)
    if found is None:
        return None
    offset_s = float(found[1]) if found[2] == "fast" else -float(found[1])
    synchronised = leap is not None and leap[1] != "Not synchronised"
    return HostClock(source="chrony", synchronised=synchronised, offset_s=offset_s if synchronised else None)


class _Timex(ctypes.Structure):
    """The beginning of struct timex of adjtimex(2), with padding for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror_us", ctypes.c_long),
        ("esterror_us", ctypes.c_long),
        ("status", ctypes.c_int),
        ("room", ctypes.c_char * 256),
    )


def _of_kernel() -> HostClock:
    """Read whether the clock is synchronised, and the kernel's bound of its error; the kernel knows no offset."""
    nothing = HostClock(source="", synchronised=None, offset_s=None)
    if not sys.platform.startswith("linux"):
        return nothing
    found = _Timex()
    if ctypes.CDLL(None).adjtimex(ctypes.byref(found)) < 0:
        return nothing
    synchronised = not found.status & _STA_UNSYNC
    error_s = seconds_of_us(found.maxerror_us)
    return HostClock(
        source="kernel",
        synchronised=synchronised,
        offset_s=None,
        error_s=error_s if synchronised and error_s < _NOT_SET_S else None,
    )


def processor_s() -> float:
    """Return the seconds that this thread has computed or waited for a processor, if the system reports waits."""
    try:
        times = processor_time(threading.get_native_id())
    except OSError:
        return time.thread_time()
    return times.computed_s + times.waited_s


def waited_s(thread: int) -> float:
    """Return the seconds that a thread (its native id) has waited for a processor; 0 if the system does not say."""
    try:
        return processor_time(thread).waited_s
    except OSError:
        return 0.0
