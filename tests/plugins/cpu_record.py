"""Records how many CPU seconds each test and each fixture costs, with all processes that they start.

`pytest --cpu-record DIR` writes one JSON line a test and a line a fixture of wider scope to `DIR/<process>.jsonl`.
`python -m bench.suite.marks` reads them. Processor time is counted rather than the clock's, so that a busy machine
changes little.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

TICKS_PER_S = os.sysconf("SC_CLK_TCK")


def cpu_s_of_tree(pid: int) -> float:
    """Return the CPU seconds of process `pid`, of its living descendants, and of those that it has waited for.

    Descendants whose parent ended before them have left the tree and are not counted. Linux only (`/proc`).
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
        threads = list(Path(f"/proc/{pid}/task").iterdir())
    except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile: its parent's next reading counts it
        return 0.0
    children: list[int] = []
    for thread in threads:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread may end meanwhile
            children += map(int, (thread / "children").read_bytes().split())
    return sum(map(int, fields[11:15])) / TICKS_PER_S + sum(map(cpu_s_of_tree, children))


class CpuRecord:
    """The plug-in: measures around every test, and around every fixture whose scope is wider than one test."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("w", encoding="utf-8")
        self._shared_s = [0.0]  # what shared fixtures cost within the present test, and within each one being set up

    def _write(self, **line: Any) -> None:
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection(self) -> Generator[None, object, object]:
        """Record what collecting the tests cost."""
        result = yield
        self._write(kind="collection", cpu_s=round(cpu_s_of_tree(os.getpid()), 2))
        return result

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Record the cost of a test, its own fixtures included and shared ones not."""
        before_s = cpu_s_of_tree(os.getpid())
        self._shared_s = [0.0]
        result = yield
        own_s = cpu_s_of_tree(os.getpid()) - before_s - self._shared_s[0]
        definitions: dict[str, Any] = getattr(getattr(item, "_fixtureinfo", None), "name2fixturedefs", {})
        shared = sorted(
            f"{chain[-1].baseid}::{name}" for name, chain in definitions.items() if chain[-1].scope != "function"
        )
        self._write(kind="test", test=item.nodeid, cpu_s=round(own_s, 2), shared=shared)
        return result

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
    ) -> Generator[None, object, object]:
        """Record what setting up a shared fixture cost, without the shared ones that were made within it."""
        if fixturedef.scope == "function":
            return (yield)
        before_s = cpu_s_of_tree(os.getpid())
        self._shared_s.append(0.0)
        try:
            return (yield)
        finally:
            whole_s = cpu_s_of_tree(os.getpid()) - before_s
            within_s = self._shared_s.pop()
            self._shared_s[-1] += whole_s
            name = f"{fixturedef.baseid}::{fixturedef.argname}"
            self._write(kind="fixture", fixture=name, cpu_s=round(whole_s - within_s, 2), at=request.node.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Record what this process cost in all."""
        self._write(kind="process", cpu_s=round(cpu_s_of_tree(os.getpid()), 2))
        self._file.close()
