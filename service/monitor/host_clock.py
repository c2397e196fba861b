"""How well this machine's clock is set: asked of chrony where it runs, else of the kernel that it would steer."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
import sys

from service.core.records.events import HostClock

_SYSTEM_TIME = re.compile(r"^System time\s*:\s*([0-9.]+) seconds (fast|slow) of NTP time", re.MULTILINE)
_LEAP = re.compile(r"^Leap status\s*:\s*(.+?)\s*$", re.MULTILINE)
_TIMEOUT_S = 3.0
_STA_UNSYNC = 0x40
_NOT_SET_S = 16.0  # the kernel's word for an error that nobody bounds


def host_clock() -> HostClock:
    """As it is now; what cannot be told is None. Never raises."""
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
    """The beginning of struct timex of adjtimex(2); the rest is room."""

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
    """Whether something sets the clock, and the error that it states at most; not by how much it is off."""
    nothing = HostClock(source="", synchronised=None, offset_s=None)
    if not sys.platform.startswith("linux"):
        return nothing
    found = _Timex()
    if ctypes.CDLL(None).adjtimex(ctypes.byref(found)) < 0:
        return nothing
    synchronised = not found.status & _STA_UNSYNC
    error_s = found.maxerror_us / 1e6
    return HostClock(
        source="kernel",
        synchronised=synchronised,
        offset_s=None,
        error_s=error_s if synchronised and error_s < _NOT_SET_S else None,
    )
