"""Says what each test costs by its records, and which tests are marked `slow` for it."""

from __future__ import annotations

import ast
import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_LIMIT_S, _LIMIT_OF_GUARDS_S = 0.8, 1.0
# What protects people and evidence is tested by `make test` also where that takes longer.
_GUARDS = tuple(f"tests/{folder}/" for folder in ("people", "recovery", "robot", "run", "server", "verify"))
LIST = Path("tests/cpu_seconds.json")
MARK = "@pytest.mark.slow"
Costs = dict[str, dict[str, float]]  # file → test function (`Class::test` in a class) → CPU seconds


@dataclass(frozen=True)
class TestFunction:
    """A test as it stands in its file: its name, the line before which a mark goes, and whether it is marked."""

    name: str
    line: int  # of its first decorator, or of `def`; counted from 1
    indent: str
    slow: bool


def limit_of(file: str) -> float:
    """Return the CPU seconds from which on a test of a file is slow."""
    return _LIMIT_OF_GUARDS_S if file.startswith(_GUARDS) else _LIMIT_S


def costs_of(folder: Path) -> Costs:
    """Return what each test function cost by the records in `folder`, shares of fixtures included."""
    records: list[dict[str, Any]] = [
        json.loads(line) for file in sorted(folder.glob("*.jsonl")) for line in file.read_text().splitlines()
    ]
    tests = [record for record in records if record["kind"] == "test"]
    users: dict[str, int] = defaultdict(int)
    for test in tests:
        for fixture in test["shared"]:
            users[fixture] += 1
    fixture_s: dict[str, float] = defaultdict(float)
    alone_s: dict[str, float] = defaultdict(float)  # asked for while the test ran: no list of users names it
    for record in records:
        if record["kind"] == "fixture":
            if users[record["fixture"]]:
                fixture_s[record["fixture"]] += record["cpu_s"]
            else:
                alone_s[record["at"]] += record["cpu_s"]
    costs: Costs = defaultdict(dict)
    for test in tests:
        share_s = sum(fixture_s[fixture] / users[fixture] for fixture in test["shared"])
        file, _, name = test["test"].partition("[")[0].partition("::")
        cost_s = test["cpu_s"] + share_s + alone_s[test["test"]]
        costs[file][name] = max(costs[file].get(name, 0.0), cost_s)
    return costs


def settled(before_s: float | None, now_s: float, limit_s: float) -> float:
    """Return the cost to be listed: the one before, unless the new one differs by more than a measurement does."""
    if before_s is None:
        return round(now_s, 1)
    if (before_s < limit_s) != (now_s < limit_s):
        return round(now_s, 1) if abs(now_s - limit_s) > 0.2 * limit_s else before_s
    return round(now_s, 1) if abs(now_s - before_s) > max(0.3, 0.3 * before_s) else before_s


def test_functions(source: str) -> Iterator[TestFunction]:
    """Yield the tests of a file's source, those of classes included, whole runs not."""

    def is_whole(decorators: list[ast.expr]) -> bool:
        return any(ast.unparse(decorator).startswith("pytest.mark.whole") for decorator in decorators)

    def within(body: list[ast.stmt], prefix: str) -> Iterator[TestFunction]:
        for node in body:
            if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
                yield from within(node.body, f"{prefix}{node.name}::")
            elif isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                if is_whole(node.decorator_list):
                    continue
                first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
                slow = any(ast.unparse(decorator) == MARK[1:] for decorator in node.decorator_list)
                yield TestFunction(prefix + node.name, first, " " * node.col_offset, slow)

    if not re.search(r"(?m)^pytestmark\b.*mark\.whole", source):
        yield from within(ast.parse(source).body, "")


def remarked(source: str, costs: Mapping[str, float], limit_s: float) -> str:
    """Return the source with the mark on those tests that cost the limit or more, and on no others."""
    lines = source.splitlines(keepends=True)
    for test in sorted(test_functions(source), key=lambda test: -test.line):
        slow = costs.get(test.name, 0.0) >= limit_s
        if slow and not test.slow:
            lines.insert(test.line - 1, f"{test.indent}{MARK}\n")
        elif test.slow and not slow:
            number = next(n for n in range(test.line - 1, len(lines)) if lines[n].strip().startswith(MARK))
            del lines[number]
    marked = "".join(lines)
    if MARK in marked and "import pytest\n" not in marked:
        marked = re.sub(
            r"(?m)^(?=from (?:tests|drivers|service|simulators|bench)\b)", "import pytest\n\n", marked, count=1
        )
    return marked


def disagreements(listed: Costs, files: Mapping[str, str]) -> list[str]:
    """Return where the list and the marks of the files (path → source) disagree, a sentence each."""
    found: list[str] = []
    for file, source in files.items():
        costs, tests = listed.get(file, {}), {test.name: test for test in test_functions(source)}
        if re.search(r"(?m)^pytestmark\b(?!.*mark\.whole).*mark\.slow", source):
            found.append(f"{file}: `slow` is marked for the whole file; it is a mark of single tests")
        found += [f"{file}::{name} is on the list and not in the file" for name in costs.keys() - tests.keys()]
        for name, test in tests.items():
            if name not in costs:
                found.append(f"{file}::{name} was not measured")
            elif test.slow != (costs[name] >= limit_of(file)):
                found.append(
                    f"{file}::{name} costs {costs[name]} CPU s and is {'' if test.slow else 'not '}marked slow"
                )
    found += [f"{file} is on the list and does not exist" for file in listed.keys() - files.keys()]
    return sorted(found)


def sources() -> dict[str, str]:
    """Return the source of every test file, by its path from the repository's root."""
    return {path.as_posix(): path.read_text() for path in sorted(Path("tests").rglob("test_*.py"))}
