"""One process of the part `together`, until SIGTERM.

`python -m tests.support.soak.roles ROLE DATA RUN LOG URL COOKIE`

The commands run within this process, so that imports are not measured. The runner is the real one on the in-memory
rig of the tests, and the worker's loop is the real one with a job that writes a small file.
"""

from __future__ import annotations

import json
import re
import signal
import sys
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import httpx
from typer.testing import CliRunner

from service.cli.main import app
from service.computations.job import JobAnswer, RecordedContext
from service.core.errors import OrthocaptureError
from service.core.records.run_events import StepNote
from service.logs import file_log
from service.store.records import NewJob
from service.store.store import Store
from service.worker import loop
from tests.support.runs.bench_run import Bench, HastyClock

KIND = "coverage_points"  # a job kind from which no page reads anything
_COMPUTED_S = 0.02  # computing time of a job
_PAUSE_S = 0.05  # pause of a reader between two requests
_WRITTEN_EVERY_S = 0.5  # interval between a person's actions


class _EndedError(BaseException):
    """SIGTERM arrived; nothing catches this."""


class Diary:
    """Log of this process: one line per action, with its duration or its error."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w")

    def timed(self, act: Callable[[], str]) -> None:
        """Time an action; a non-empty return value is an error."""
        began_s = time.perf_counter()
        try:
            error = act()
        except (OrthocaptureError, httpx.HTTPError) as caught:
            error = f"{type(caught).__name__}: {caught}"
        self.write(time.perf_counter() - began_s, error)

    def write(self, seconds: float, error: str = "") -> None:
        """Write one line."""
        line = {"seconds": seconds} | ({"error": error[:600]} if error else {})
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()


def read(diary: Diary, *words: str) -> None:
    """Run a command again and again."""
    runner = CliRunner()

    def command() -> str:
        answer = runner.invoke(app, [*words, "--json"])
        return "" if answer.exit_code == 0 else f"status {answer.exit_code}: {answer.output} {answer.exception}"

    while True:
        diary.timed(command)
        time.sleep(_PAUSE_S)


def pages(diary: Diary, run: str, url: str, cookie: str) -> None:
    """Request the pages of the run in turn."""
    addresses = cycle(
        ["/", f"/runs/{run}", f"/runs/{run}/capture", f"/audit/runs/{run}", f"/audit/runs/{run}/timeline", "/health"]
    )
    with httpx.Client(base_url=url, headers={"Cookie": cookie}, timeout=60) as client:

        def get() -> str:
            address = next(addresses)
            try:
                answer = client.get(address)
            except (httpx.ReadError, httpx.RemoteProtocolError):
                answer = client.get(address)  # the idle connection was closed: every browser retries once
            # /health may report that no worker is alive: none of the workers here is a whole `worker` command.
            well = answer.status_code == 200 or (address == "/health" and "locked" not in answer.text)
            return "" if well else f"{address} answers {answer.status_code}: {_words(answer.text)[:300]}"

        while True:
            diary.timed(get)
            time.sleep(_PAUSE_S)


def _words(html: str) -> str:
    return " ".join(re.sub(r"<[^>]+>", " ", html).split())


def run_it(diary: Diary, store: Store, data: Path, run: str) -> None:
    """The runner, with a job for every photograph."""
    bench = Bench(store, run, data)
    last_s = time.perf_counter()

    def exposed(number: int) -> None:
        nonlocal last_s
        now_s = time.perf_counter()
        diary.write(now_s - last_s)
        last_s = now_s
        job = NewJob(KIND, "capture", 1, f"capture/1/{KIND}/{number}", {"number": number})
        store.record(run, [], actor="runner", jobs=[job])

    bench.rig.shutter.on_capture = exposed
    bench.run()


def compute(diary: Diary, store: Store) -> None:
    """The worker's loop, with a job that writes a small file."""

    def handle(context: RecordedContext) -> JobAnswer:
        time.sleep(_COMPUTED_S)
        ref = context.keep_json(dict(context.arguments), kind="coverage_points", name="answer.json")
        return JobAnswer({"number": float(context.arguments["number"])}, (ref,))

    last_s = time.perf_counter()

    def finished() -> None:
        nonlocal last_s
        now_s = time.perf_counter()
        diary.write(now_s - last_s)
        last_s = now_s

    loop.HANDLERS = {KIND: handle}
    loop.work(store, until_idle=False, stop=lambda: False, progress=lambda *_: None, finished=finished)


def write(diary: Diary, store: Store, run: str) -> None:
    """A person whose button presses are recorded."""

    def press() -> str:
        store.record(run, [StepNote(step="capture", attempt=1, note="pressed")], actor="Grace")
        return ""

    while True:
        diary.timed(press)
        time.sleep(_WRITTEN_EVERY_S)


def main(role: str, data: Path, run: str, log: Path, url: str, cookie: str) -> None:
    """Run the role until SIGTERM."""

    def on_terminate(_signal: int, _frame: object) -> None:
        raise _EndedError

    signal.signal(signal.SIGTERM, on_terminate)
    diary = Diary(log)
    try:
        clock = HastyClock() if role == "runner" else None
        with Store.open(data, clock) as store, file_log(data, "worker" if role == "worker" else "runner"):
            match role:
                case "status":
                    read(diary, "status", "latest", "--data", str(data))
                case "audit show":
                    read(diary, "audit", "show", "latest", "--data", str(data))
                case "pages":
                    pages(diary, run, url, cookie)
                case "runner":
                    run_it(diary, store, data, run)
                case "worker":
                    compute(diary, store)
                case _:
                    write(diary, store, run)
    except _EndedError:
        pass


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3], Path(sys.argv[4]), sys.argv[5], sys.argv[6])
