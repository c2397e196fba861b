"""Records which functions of the subjects each test reaches: a plug-in of pytest, loaded by record.py.

Coverage with a context for each test. What a fixture of wider scope runs counts for every test that uses it. Code in
child processes is not seen: the fast tests of the subjects run in their own process.
"""

from __future__ import annotations

import ast
import json
import os
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path
from typing import Any, NamedTuple

import coverage
import pytest

from tests.support.mutants.subjects import sources

TARGET = "ORTHOCAPTURE_MUTANTS_RECORD"  # environment variable: the file to write
IMPORTED = "imported"  # context of what runs outside tests
TREE = Path.cwd()


def cpu_s() -> float:
    """CPU seconds of this process and of the children that it waited for."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


class Span(NamedTuple):
    """Says where a function stands in its file; decorators are its first lines."""

    first: int
    body: int
    last: int
    name: str


def functions(file: Path) -> list[Span]:
    """Return where each function of a file stands; an inner function belongs to the outermost one."""
    found: list[Span] = []

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
                found.append(Span(first, node.body[0].lineno, node.end_lineno or node.lineno, prefix + node.name))
            elif isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")

    visit(ast.parse(file.read_bytes()).body, "")
    return found


class Recorder:
    """Switches the context with each test and each shared fixture, and writes what was reached at the end."""

    def __init__(self) -> None:
        files = sorted({file for of_subject in sources(TREE).values() for file in of_subject})
        self._files = files
        include = [str(TREE / file) for file in files]
        self._coverage = coverage.Coverage(data_file=None, config_file=False, include=include)
        self._coverage.start()
        self._coverage.switch_context(IMPORTED)
        self._context = [IMPORTED]
        self._cost_s: dict[str, float] = {}
        self._shared: dict[str, list[str]] = {}
        self._failed: set[str] = set()

    def _switch(self, context: str) -> None:
        self._coverage.switch_context(context)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Give each test its context."""
        before_s = cpu_s()
        definitions: dict[str, Any] = getattr(getattr(item, "_fixtureinfo", None), "name2fixturedefs", {})
        wide = [chain[-1] for chain in definitions.values() if chain[-1].scope != "function"]
        self._shared[item.nodeid] = [f"{d.baseid}::{d.argname}" for d in wide]
        self._context.append(item.nodeid)
        self._switch(item.nodeid)
        try:
            return (yield)
        finally:
            self._context.pop()
            self._switch(IMPORTED)
            self._cost_s[item.nodeid] = cpu_s() - before_s

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, object, object]:
        """Give each fixture of wider scope than one test its context."""
        if fixturedef.scope == "function":
            return (yield)
        name = f"{fixturedef.baseid}::{fixturedef.argname}"
        self._context.append(name)
        self._switch(name)
        try:
            return (yield)
        finally:
            self._context.pop()
            self._switch(self._context[-1])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Leave out what fails without a mutation."""
        if report.outcome != "passed":
            self._failed.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Write what was reached."""
        self._coverage.stop()
        data = self._coverage.get_data()
        users: dict[str, set[str]] = defaultdict(set)
        for test, names in self._shared.items():
            users[test].add(test)
            for name in names:
                users[name].add(test)
        reached: dict[str, dict[str, list[str]]] = {}
        for file in self._files:
            by_line = data.contexts_by_lineno(str(TREE / file))
            of_file: dict[str, set[str]] = {}
            for first, _body, last, name in functions(TREE / file):
                contexts = {c for line in range(min(first + 1, last), last + 1) for c in by_line.get(line, [])}
                tests = {t.partition("[")[0] for c in contexts for t in users.get(c, ()) if t not in self._failed}
                of_file[name] = tests
            reached[file] = {name: sorted(tests) for name, tests in of_file.items()}
        costs: dict[str, float] = defaultdict(float)
        for test, cost in self._cost_s.items():
            if test not in self._failed:
                costs[test.partition("[")[0]] += cost
        text = json.dumps({"costs": {t: round(s, 3) for t, s in costs.items()}, "reached": reached})
        Path(os.environ[TARGET]).write_text(text)


def pytest_configure(config: pytest.Config) -> None:
    """Start to record before anything of the program is imported."""
    config.pluginmanager.register(Recorder())
