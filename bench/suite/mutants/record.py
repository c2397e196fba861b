"""Renews reached.json: runs the fast tests that are new or have changed since, with coverage."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY
from tests.support.mutants.reach import RECORD, digest, files_of_tests
from tests.support.mutants.recorder import TARGET
from tests.support.mutants.trial import CHOSEN, copied_tree


@dataclass(frozen=True, slots=True)
class Recorded:
    """Holds what tests cost, and which reach each function of each file."""

    costs: dict[str, float]
    reached: dict[str, dict[str, list[str]]]

    @classmethod
    def kept(cls, record: Mapping[str, Any], of_files: set[str]) -> Recorded:
        """Those of a record whose test files are the same still."""
        tests: list[str] = list(record["tests"])
        return cls(
            {test: cost for test, cost in record["tests"].items() if test.partition("::")[0] in of_files},
            {
                file: {
                    name: [tests[n] for n in numbers if tests[n].partition("::")[0] in of_files]
                    for name, numbers in of_file.items()
                }
                for file, of_file in record["reached"].items()
            },
        )

    def with_more(self, more: Recorded) -> Recorded:
        """These and those of newer files; which functions there are is known by the newer one."""
        reached = {
            file: {
                name: sorted({*tests, *self.reached.get(file, {}).get(name, ())}) for name, tests in of_file.items()
            }
            for file, of_file in more.reached.items()
        }
        return Recorded(self.costs | more.costs, reached)


def record_reach(folder: Path) -> None:
    """Run the tests in a copy of the tree below `folder`, and write what they reached into the repository."""
    tree = copied_tree(folder / "tree", None)
    files = files_of_tests(tree)
    old: dict[str, Any] = {"tests": {}, "files": {}, "reached": {}}
    if (tree / RECORD).exists():
        old = json.loads((tree / RECORD).read_text())
    same = {file for file in files if old["files"].get(file) == digest((tree / file).read_text())}
    changed = [file for file in files if file not in same]
    if not changed:
        return
    told = folder / "told.json"
    words = [
        *(sys.executable, "-m", "pytest", "-q", "-o", "addopts=", "--strict-markers", "--import-mode=importlib"),
        *("-p", "tests.support.mutants.recorder", "-p", "no:cacheprovider", *CHOSEN),
        *("--basetemp", str(folder / "tmp"), *changed),
    ]
    path = os.pathsep.join([str(tree), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {TARGET: str(told), "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(words, cwd=tree, env=environment, check=False)  # what fails is left out
    new = json.loads(told.read_text())
    whole = Recorded.kept(old, same).with_more(Recorded(new["costs"], new["reached"]))
    (REPOSITORY / RECORD).write_text(compact(whole, tree))


def compact(recorded: Recorded, tree: Path) -> str:
    """The record as it is kept: each test is named once, a line a function."""
    tests = sorted(recorded.costs)
    number = {test: n for n, test in enumerate(tests)}
    lines = ["{", '"tests": {']
    lines.append(",\n".join(f"{json.dumps(test)}: {round(recorded.costs[test], 2)}" for test in tests))
    lines += ["},", '"files": {']
    digests = {file: digest((tree / file).read_text()) for file in files_of_tests(tree)}
    lines.append(",\n".join(f"{json.dumps(file)}: {json.dumps(text)}" for file, text in digests.items()))
    lines += ["},", '"reached": {']
    parts: list[str] = []
    for file, of_file in recorded.reached.items():
        inner = [
            f" {json.dumps(name)}: {json.dumps(sorted(number[t] for t in of if t in number), separators=(',', ':'))}"
            for name, of in of_file.items()
        ]
        parts.append(f"{json.dumps(file)}: {{\n" + ",\n".join(inner) + "\n}")
    lines += [",\n".join(parts), "}", "}"]
    return "\n".join(lines) + "\n"
