"""Which fast tests reach a function, as recorded in reached.json.

`python -m bench.suite.mutants --reach` renews the file; that takes minutes, so it is kept in the repository. Test
files that are new or have changed since are added whole wherever they import the mutated module, so an older record
hides no test.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from tests.support.mutants.recorder import functions
from tests.support.mutants.subjects import OWN_TESTS, TESTS, sources

RECORD = Path("bench/suite/mutants/reached.json")
WHOLE_FILE_S = 3.0  # assumed of a test file whose tests were not recorded
LIMIT_S = 25.0  # CPU seconds; from here on only the subject's own tests run


@dataclass(frozen=True, slots=True)
class Selected:
    """The tests of one mutation: a file, its chosen tests (none: all), and what they cost when they were recorded."""

    file: str
    tests: tuple[str, ...]
    cost_s: float

    @property
    def arguments(self) -> list[str]:
        """As pytest takes them."""
        return [f"{self.file}::{test}" for test in self.tests] or [self.file]


class Reach:
    """The record, and the tree whose tests are to be chosen."""

    def __init__(self, tree: Path) -> None:
        self._tree = tree
        record: dict[str, Any] = json.loads((tree / RECORD).read_text())
        self._tests: list[str] = list(record["tests"])
        self._costs: dict[str, float] = record["tests"]
        self._files: dict[str, str] = record["files"]
        self._reached: dict[str, dict[str, list[int]]] = record["reached"]

    @cached_property
    def _present(self) -> dict[str, str]:
        """Texts of the test files of the tree."""
        return {file: (self._tree / file).read_text() for file in files_of_tests(self._tree)}

    def _in_order(self, file: str, tests: Iterable[str]) -> tuple[str, ...]:
        """Tests in the order of their file, since some share a fixture that an earlier one leaves changed."""
        text = self._present[file]
        return tuple(sorted(tests, key=lambda test: text.index(f"def {test.rpartition('::')[2]}(")))

    def selected(self, subject: str, file: str, line: int) -> list[Selected]:
        """The files with tests that reach a line: all of the subject's own, then others, as far as the limit allows.

        The cheapest come first.
        """
        name = next((name for first, _body, last, name in functions(self._tree / file) if first <= line <= last), "")
        recorded = self._reached.get(file, {})
        if not recorded:  # no function is known: the rest of the subject uses what it defines
            of_subject = (self._reached.get(other, {}) for other in sources(self._tree)[subject])
            recorded = {"": sorted({n for of in of_subject for numbers in of.values() for n in numbers})}
        numbers: Iterable[int] = recorded[name] if name in recorded else {n for of in recorded.values() for n in of}
        by_file: dict[str, list[str]] = {}
        for test in (self._tests[n] for n in numbers):
            of, _, function = test.partition("::")
            if re.search(rf"def {re.escape(function.rpartition('::')[2])}\(", self._present.get(of, "")):
                by_file.setdefault(of, []).append(function)
        found = [
            Selected(of, self._in_order(of, tests), sum(self._costs[f"{of}::{test}"] for test in tests))
            for of, tests in by_file.items()
        ]
        module = re.escape(file.removesuffix(".py").replace("/", "."))
        package, _, last = module.rpartition(r"\.")
        imports = re.compile(
            rf"^\s*(from {module} import|import {module}\b|from {package} import .*\b{last}\b)", re.M
        )
        for of, text in self._present.items():
            if self._files.get(of) != digest(text) and imports.search(text):
                found = [one for one in found if one.file != of]
                found.append(Selected(of, (), WHOLE_FILE_S))
        own = tuple(f"{folder}/" for folder in OWN_TESTS[subject])
        found.sort(key=lambda one: (one.cost_s, one.file))
        kept = [one for one in found if one.file.startswith(own)]
        for one in found:
            if one not in kept and sum(other.cost_s for other in kept) + one.cost_s <= LIMIT_S:
                kept.append(one)
        return kept


def files_of_tests(tree: Path) -> list[str]:
    """The files whose tests are recorded."""
    return sorted(p.relative_to(tree).as_posix() for of in TESTS for p in (tree / of).glob("**/test_*.py"))


def digest(text: str) -> str:
    """Short hash of a file, by which a change is noticed."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]
