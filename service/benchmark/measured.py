"""Runs a command and reports the time and memory that it took, from a small process of its own.

Linux counts the memory of the process that starts a command as memory of the command. This one has hardly any.

Run: python measured.py DESCRIPTOR COMMAND...; it needs nothing but the standard library.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time


def main() -> None:
    """Run the command, and write to an open file descriptor what it took or why it could not be started."""
    descriptor, command = int(sys.argv[1]), sys.argv[2:]
    began = time.monotonic()
    said: dict[str, float | str]
    try:
        process = subprocess.Popen(command)
    except OSError as error:
        said = {"refused": error.strerror or str(error)}
    else:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said = {
            "status": process.returncode,
            "wall_s": time.monotonic() - began,
            "cpu_s": used.ru_utime + used.ru_stime,
            "peak_bytes": 1024 * used.ru_maxrss,
        }
    os.write(descriptor, json.dumps(said).encode())


if __name__ == "__main__":
    main()
