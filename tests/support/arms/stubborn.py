"""Runs a program that always moves its arm on, for tests that kill or suspend it or its driver."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from pydantic import BaseModel

from tests.support.processes.forked import Forked

_ENDED: dict[str, Any] = {}  # follows the last line
_WITHIN_S = 120.0  # which only a hang reaches


class Program:
    """tests.support.processes.stubborn_program as a process.

    Args:
        spec, config: the driver.
        goals_rad: between which its first joint moves.
        motion: its speed (rad/s) and acceleration (rad/s²); the fastest motion of protocols/demo.yaml by default.
    """

    def __init__(
        self,
        spec: str,
        config: BaseModel,
        goals_rad: tuple[float, float],
        *,
        motion: tuple[float, float] = (1.0, 1.5),
    ) -> None:
        numbers = map(str, (*goals_rad, *motion))
        words = (spec, config.model_dump_json(), *numbers)
        self._process = Forked(
            [sys.executable, "-m", "tests.support.processes.stubborn_program", *words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.driver = 0
        try:
            self.driver = int(self.next("driver")["driver"])
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        return self._process.pid

    def let_move(self, person: str) -> None:
        """Let the arm move for a person; again while it is refused because the stream is old, say."""
        until_s = time.monotonic() + _WITHIN_S
        answer: dict[str, Any] = {}
        while answer.get("let_by") != person:
            assert time.monotonic() < until_s, answer
            self._write(person)
            answer = self.next("let_by")

    def hang(self) -> None:
        """Let its main loop hang as soon as the arm moves."""
        self._write("hang")

    def go_on(self, person: str, moving: Callable[[], bool]) -> None:
        """Let the arm move until it does, once more when this machine's lapse has taken the leave away."""
        self.let_move(person)
        until_s = time.monotonic() + _WITHIN_S
        while not moving():
            assert time.monotonic() < until_s, "it does not move"
            if self._has_lost_leave():
                self.let_move(person)
            time.sleep(0.002)

    def fails_with(self, error: str) -> dict[str, Any]:
        """Return the next failure of this class."""
        while (line := self.next("error"))["error"] != error:
            pass
        return line

    def send(self, *signals: tuple[str, signal.Signals]) -> None:
        """Send signals to `program` or `driver`."""
        for to, which in signals:
            os.kill(self.driver if to == "driver" else self.pid, which)

    def next(self, key: str, within_s: float = _WITHIN_S) -> dict[str, Any]:
        """Return the next line with this key; fail, with the lines that came instead, if none comes in time."""
        deadline_s = time.monotonic() + within_s
        others: list[dict[str, Any]] = []
        while True:
            try:
                line = self._lines.get(timeout=max(0.01, deadline_s - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"the program has not said {key!r}, but: {others}") from None
            if key in line:
                return line
            if line == _ENDED:
                raise AssertionError(f"the program ended before it said {key!r}; it said: {others}")
            others.append(line)

    def close(self) -> None:
        """End the program; its driver, if it was stopped, runs on and ends by itself."""
        with contextlib.suppress(ProcessLookupError):
            if self.driver:
                os.kill(self.driver, signal.SIGCONT)
        self._process.kill()
        self._process.wait(90)
        self._reader.join(90)
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()

    def _write(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _has_lost_leave(self) -> bool:
        lost = False
        while not self._lines.empty():
            lost |= self._lines.get().get("error") == "LeaveNeededError"
        return lost

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(json.loads(line))
        self._lines.put(_ENDED)
