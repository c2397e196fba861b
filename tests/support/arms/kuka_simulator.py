"""Runs simulated KUKA controllers for tests, presses what is on their pendant, and reads the golden transcripts."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Generator
from pathlib import Path
from typing import Any, Protocol

from tests.support.rig.patience import PATIENCE_S
from tests.support.rig.simulator_process import simulator


#: Starts what answers at the ports of a controller on an address.
class Controller(Protocol):
    def __call__(
        self, host: str, *, patience_s: float = PATIENCE_S
    ) -> contextlib.AbstractContextManager[dict[str, Any]]: ...


TRANSCRIPTS = Path(__file__).parents[2] / "data" / "kuka"


@contextlib.contextmanager
def simulated_kuka(host: str, *options: str, patience_s: float = PATIENCE_S) -> Generator[dict[str, Any]]:
    """Run `python -m simulators kuka`; yields its ready line."""
    words = ("--host", host, "--parent", str(os.getpid()), "--patience", str(patience_s))
    with simulator("kuka", *words, *options) as running:
        yield running.ready


def pendant(host: str, order: str) -> None:
    """Do what a person does at the smartPAD."""
    with socket.create_connection((host, 30011), timeout=90) as connection, connection.makefile("rw") as lines:
        lines.write(order + "\n")
        lines.flush()
        assert lines.readline().strip() == "ok", order


def transcript(name: str) -> list[dict[str, Any]]:
    """The rows of a golden transcript."""
    return [json.loads(row) for row in (TRANSCRIPTS / name).read_text().splitlines()]


def agrees(line: dict[str, Any], golden: dict[str, Any]) -> bool:
    """Return whether a line has the fields of the golden one, and its values where that is not `*`."""
    return line.keys() == golden.keys() and all(value in ("*", line[name]) for name, value in golden.items())
