"""Every method of ur_rtde and every camera configuration name, tested against the simulators, in one table.

`python -m bench.vendor.surface` writes bench/results/vendor_surface.md. It exits with status 1 if an answer is not as
expected, or if the vendor's client has a method that bench.vendor.calls and bench.vendor.reads do not list.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Generator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from bench.machine import RESULTS, commit, machine
from bench.vendor.session import INTERFACES
from bench.vendor.widgets import LISTED, look

RESULT = RESULTS / "vendor_surface.md"
HOST, NEW_HOST = "127.7.80.1", "127.7.80.2"
TIME_BOX_S = 20.0
CRASHED = "the client crashed"
_MARK = "@@"


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a table."""

    name: str
    worth: str
    answer: str
    note: str
    right: bool


@contextlib.contextmanager
def simulator(*words: str) -> Generator[dict[str, Any]]:
    """Run a simulator as a process; yields its ready line."""
    command = [sys.executable, "-m", "simulators", *words, "--parent", str(os.getpid())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.terminate()


class Child:
    """A process with the vendor's clients; killed and replaced if it does not answer in time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask(self, interface: str, method: str) -> dict[str, Any]:
        """Make one call; the result says so if no answer came or the process died."""
        process = self._process
        if process is None or process.poll() is not None:
            process = self._process = self._start()
        assert process.stdin is not None
        process.stdin.write(f"{interface}\t{method}\n")
        process.stdin.flush()
        try:
            line = self._lines.get(timeout=TIME_BOX_S)
        except queue.Empty:
            return self._lost(process, f"no answer within {TIME_BOX_S:g} s")
        return json.loads(line) if line else self._lost(process, CRASHED)

    def _start(self) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", "bench.vendor.session", HOST, NEW_HOST],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, bufsize=1,
        )  # fmt: skip
        self._lines = queue.SimpleQueue()
        threading.Thread(target=_read, args=(process, self._lines), daemon=True).start()
        return process

    def _lost(self, process: subprocess.Popen[str], why: str) -> dict[str, Any]:
        process.kill()
        process.wait()
        self._process = None
        return {"value": why, "right": False, "seconds": 0.0}

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._lost(self._process, "")


def _read(process: subprocess.Popen[str], lines: queue.SimpleQueue[str]) -> None:
    """Queue the child's answers, and an empty line at its end; skips lines printed by the library."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(_MARK):
            lines.put(line.removeprefix(_MARK))
    lines.put("")


def robot_tables(only: str) -> dict[str, list[Row]]:
    """One table per interface with every method of the five interfaces."""
    tables: dict[str, list[Row]] = {}
    child = Child()
    options = ("--model", "UR10e", "--speed-up", "5")
    with (
        simulator("ur", "--host", HOST, "--version", "5.12", *options),
        simulator("ur", "--host", NEW_HOST, "--version", "5.26", *options),
    ):
        try:
            for interface, (vendor, calls) in INTERFACES.items():
                methods = {name for name in dir(vendor) if not name.startswith("_") and name[0].islower()}
                unlisted = [
                    Row(name, "", "", "not looked at", right=False) for name in sorted(methods - calls.keys())
                ]
                rows = [_row(child, interface, method) for method in sorted(calls) if only in method]
                tables[interface] = unlisted + rows
        finally:
            child.close()
    return tables


def _row(child: Child, interface: str, method: str) -> Row:
    call = INTERFACES[interface][1][method]
    said = child.ask(interface, method)
    if call.crashes:
        said["right"] = said["value"] == CRASHED
    print(
        f"{'ok  ' if said['right'] else 'FAIL'} {interface}.{method} {said['value']} {said['seconds']} s", flush=True
    )
    return Row(method, call.worth, said["value"], call.note, said["right"])


def camera_table() -> list[Row]:
    """Every configuration name of the camera, including those that are listed but do not exist."""
    with simulator("camera", "--port", "0", "--image-width", "480") as ready:
        found = look(ready["gphoto_port"])
    rows: list[Row] = []
    for name, (answer, works) in found.items():
        worth, note = LISTED.get(name, ("", "not looked at"))
        rows.append(Row(name, worth, answer, note, works and name in LISTED))
        print(f"{'ok  ' if rows[-1].right else 'FAIL'} {name} {answer}", flush=True)
    rows += [Row(name, "", "missing", "", right=False) for name in LISTED if name not in found]
    return rows


def markdown(tables: dict[str, list[Row]]) -> str:
    """Format the document as Markdown."""
    lines = ["# Every call of the vendors' clients against the simulators", ""]
    where = machine()
    lines += [
        f"Made by `python -m bench.vendor.surface` on {datetime.now(UTC):%Y-%m-%d}, revision {commit()}, "
        f"{where['processor']}, Python {where['python']}. ur_rtde 1.6.5 and python-gphoto2 are unmodified; the"
        " simulated controllers are an UR10e with Polyscope 5.12, and 5.26 for what came later, five times as fast as"
        " a real one. What a real device answers is taken from its maker's documents and the clients' own scripts; it"
        " was not measured on one.",
        "",
    ]
    for title, rows in tables.items():
        good = sum(row.right for row in rows)
        lines += [f"## {title}: {good} of {len(rows)} as expected", "", "| name | simulated | answer | remark |"]
        lines += ["|---|---|---|---|"]
        for row in rows:
            worth = row.worth if row.right else f"**differs** ({row.worth})"
            cells = (row.name, worth, f"`{row.answer}`", row.note)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Make every call, print progress, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="only methods whose name contains this; writes no table")
    arguments = parser.parse_args()
    tables = robot_tables(arguments.only)
    if not arguments.only:
        tables["Camera body (configuration of ILCE-7RM5)"] = camera_table()
        RESULT.write_text(markdown(tables), encoding="utf-8")
    wrong = [f"{title}: {row.name}" for title, rows in tables.items() for row in rows if not row.right]
    sys.exit("differs: " + ", ".join(wrong) if wrong else 0)


if __name__ == "__main__":
    main()
