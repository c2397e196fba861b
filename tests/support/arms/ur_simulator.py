"""Runs simulated Universal Robots controllers for tests, each on its own address."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Generator


def address(number: int) -> str:
    """A loopback address that no other test worker uses, because the controller's ports are fixed."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    return f"127.7.{10 + int(worker)}.{number}"


@contextlib.contextmanager
def simulated_ur(host: str, *options: str) -> Generator[dict[str, str]]:
    """Run `python -m simulators ur`; yields its ready line."""
    command = [sys.executable, "-m", "simulators", "ur", "--host", host, "--parent", str(os.getpid()), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            assert line, f"the simulator did not start: {' '.join(command)}"
            yield json.loads(line)
        finally:
            process.terminate()
            status = process.wait(10)
    assert status == 0, f"the simulator ended with status {status}"
