"""Runs simulated Universal Robots controllers for tests, each on its own address."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Generator

from tests.support.rig.patience import PATIENCE_S
from tests.support.rig.simulator_process import simulator


def address(number: int) -> str:
    """A loopback address that no other test worker uses, because the controller's ports are fixed."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    return f"127.7.{10 + int(worker)}.{number}"


@contextlib.contextmanager
def simulated_ur(host: str, *options: str, patience_s: float = PATIENCE_S) -> Generator[dict[str, str]]:
    """Run `python -m simulators ur`; yields its ready line."""
    words = ("--host", host, "--parent", str(os.getpid()), "--patience", str(patience_s))
    with simulator("ur", *words, *options) as running:
        yield running.ready


def pendant(host: str, *orders: str) -> None:
    """Do what a person does at the pendant, or with a hand on the arm (simulators/ur_controller/pendant.py)."""
    with socket.create_connection((host, 30090), timeout=90) as connection, connection.makefile("rw") as lines:
        for order in orders:
            lines.write(order + "\n")
            lines.flush()
            assert lines.readline().strip() == "ok", order
