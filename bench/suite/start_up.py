"""CPU seconds that each kind of process costs before it is of use: commands, a driver's host, simulators, a worker.

The code must be compiled, as a user's is: the script compiles it first. Times of the processor are stated and not
those of a clock, because the machine may be busy with other work.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY, RESULTS, commit, machine
from drivers.host.doing import Note
from drivers.ur import UrConfig
from tests.support.recorded.unpacked_run import unpack_recorded_run

ROUNDS = 7
SIMULATORS = {
    "ur": ("--host", "{host}"),
    "kuka": ("--host", "{host}", "--port", "0"),
    "camera": ("--port", "0"),
    "lightbox": (),
}
_COMMAND = (sys.executable, "-m", "service.cli.main")
_RIG = "name: bench\nsimulated: true\ndevices: {}\n"


def _environment() -> dict[str, str]:
    """As a user has it: byte code is written and used."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def whole_s(words: Sequence[str]) -> float:
    """CPU seconds of a program from its start to its end. Raises CalledProcessError if it fails."""
    process = subprocess.Popen(
        words, cwd=REPOSITORY, env=_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    return _end(process, words)


def until_ready_s(words: Sequence[str]) -> float:
    """CPU seconds of a program until it writes a first line; it is terminated then."""
    process = subprocess.Popen(
        words, cwd=REPOSITORY, env=_environment(), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdout is not None
    with process.stdout:
        line = process.stdout.readline()
        spent_s = _spent_s(process.pid)
        process.terminate()
        process.stdout.read()
    process.wait()
    if not line:
        raise subprocess.CalledProcessError(process.returncode, list(words))
    return spent_s


def driver_host_s() -> float:
    """CPU seconds of a driver's process with an arm's driver in it, as the station starts one."""
    ours, theirs = socket.socketpair()
    note = Note()
    words = (sys.executable, "-m", "drivers.host", str(theirs.fileno()), str(note.descriptor))
    process = subprocess.Popen(
        words,
        cwd=REPOSITORY,
        env=_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        pass_fds=[theirs.fileno(), note.descriptor],
    )
    theirs.close()
    with Connection(ours.detach()) as line:
        line.send(
            (1, "start", ("drivers.ur:DRIVER", UrConfig(host="127.0.0.1").model_dump_json(), 60.0, note.left_out), {})
        )
        _sequence, well, answer = line.recv()
        if not well:
            raise answer
    return _end(process, words)


def _end(process: subprocess.Popen[bytes], words: Sequence[str]) -> float:
    assert process.stderr is not None
    with process.stderr:
        said = process.stderr.read()
    _pid, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, list(words), stderr=said.decode(errors="replace"))
    return used.ru_utime + used.ru_stime


def _spent_s(pid: int) -> float:
    """CPU seconds of another process until now: its clock, as clock_getcpuclockid(3) of Linux names it."""
    return time.clock_gettime((~pid << 3) | 2)


def measures(folder: Path, data: Path) -> dict[str, Callable[[], float]]:
    """What is measured, by name; `data` holds a completed run, and a server gets a new folder inside `folder`."""
    rig = folder / "rig.yaml"
    rig.write_text(_RIG, encoding="utf-8")

    def command(*words: str) -> Callable[[], float]:
        return lambda: whole_s((*_COMMAND, *words))

    def serve() -> float:
        with tempfile.TemporaryDirectory(dir=folder) as new:
            return until_ready_s(
                (*_COMMAND, "serve", "--rig", str(rig), "--data", f"{new}/data", "--port", "0", "--json")
            )

    def simulator(name: str) -> Callable[[], float]:
        # The ports of a controller are fixed; another loopback address cannot be another simulator's.
        host = f"127.{os.getpid() % 200 + 20}.{os.getpid() // 200 % 250}.9"
        options = [word.format(host=host) for word in SIMULATORS[name]]
        return lambda: until_ready_s((sys.executable, "-m", "simulators", name, *options))

    return {
        "python -c pass": lambda: whole_s((sys.executable, "-c", "pass")),
        "--help": command("--help"),
        "status latest": command("status", "latest", "--data", str(data)),
        "serve, to ready": serve,
        "worker, one child, nothing to do": command("worker", "--until-idle", "--jobs", "1", "--data", str(data)),
        "driver's process (ur)": driver_host_s,
        **{f"simulator {name}, to ready": simulator(name) for name in SIMULATORS},
    }


def markdown(rows: Sequence[dict[str, Any]], about: dict[str, Any], measured: str) -> str:
    """Format the table and its explanation."""
    lines = [f"| {row['process']} | {row['cpu_s']:.2f} | {row['least_cpu_s']:.2f} |" for row in rows]
    table = "\n".join(("| process | median CPU s | least CPU s |", "|---|---|---|", *lines))
    return f"""# What a process costs to start

{about["processor"]}, {about["cores"]} cores, Python {about["python"]}, commit {measured}. CPU seconds (user and
system) of {len(rows[0]["all_cpu_s"])} starts each, byte code compiled, files in the page cache. "To ready": until the
first line on standard output; the others until they end.

{table}
"""


def main() -> None:
    """Measure, print the table, and write it with the single values."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="starts of each process")
    parser.add_argument("--only", default="", metavar="WORD", help="only processes with this word in their name")
    parser.add_argument("--out", type=Path, help="folder for the results; bench/results when all is measured")
    options = parser.parse_args()
    for package in ("service", "drivers", "simulators", "protocols"):
        compileall.compile_dir(REPOSITORY / package, quiet=1)
    with tempfile.TemporaryDirectory(prefix="start-up-") as name:
        folder = Path(name)
        wanted = measures(folder, unpack_recorded_run(folder))
        wanted = {what: measure for what, measure in wanted.items() if options.only in what}
        values: dict[str, list[float]] = {what: [] for what in wanted}
        for _round in range(options.rounds + 1):
            for what, measure in wanted.items():  # in turn, so that other load meets all of them
                values[what].append(measure())
    rows = [
        {
            "process": what,
            "cpu_s": round(statistics.median(each[1:]), 3),  # the first start filled the caches
            "least_cpu_s": round(min(each[1:]), 3),
            "all_cpu_s": [round(one, 3) for one in each[1:]],
        }
        for what, each in values.items()
    ]
    about, measured = machine(), commit()
    text = markdown(rows, about, measured)
    print(text)
    out = options.out or (None if options.only else RESULTS)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        stem = f"start_up-{datetime.now(UTC):%Y-%m-%d}"
        record = {"machine": about, "commit": measured, "rows": rows}
        (out / f"{stem}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        (out / f"{stem}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
