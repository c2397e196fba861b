"""Renews reached.json: runs the fast tests of the subjects once, with coverage."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from bench.machine import REPOSITORY
from bench.suite.mutants.reach import RECORD, digest, files_of_tests
from bench.suite.mutants.recorder import TARGET
from bench.suite.mutants.subjects import TESTS
from bench.suite.mutants.trial import copied_tree


def record_reach(folder: Path) -> None:
    """Run the tests in a copy of the tree below `folder`, and write what they reached into the repository."""
    tree = copied_tree(folder / "tree", None)
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".json") as told:
        words = [
            *(sys.executable, "-m", "pytest", "-q", "-o", "addopts=", "--strict-markers", "--import-mode=importlib"),
            *("-p", "bench.suite.mutants.recorder", "-p", "no:cacheprovider", "-m", "not slow and not realtime"),
            *("--basetemp", str(folder / "tmp"), *TESTS),
        ]
        environment = os.environ | {TARGET: told.name, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
        subprocess.run(words, cwd=tree, env=environment, check=False)  # what fails is left out
        text = Path(told.name).read_text()
    (REPOSITORY / RECORD).write_text(compact(json.loads(text), tree))


def compact(recorded: dict[str, Any], tree: Path) -> str:
    """The record as it is kept: each test is named once, a line a function."""
    costs: dict[str, float] = recorded["costs"]
    tests = sorted(costs)
    number = {test: n for n, test in enumerate(tests)}
    files = files_of_tests(tree)
    lines = ["{", '"tests": {']
    lines.append(",\n".join(f"{json.dumps(test)}: {round(costs[test], 2)}" for test in tests))
    lines += ["},", '"files": {']
    lines.append(",\n".join(f"{json.dumps(file)}: {json.dumps(digest((tree / file).read_text()))}" for file in files))
    lines += ["},", '"reached": {']
    reached: dict[str, dict[str, list[str]]] = recorded["reached"]
    parts: list[str] = []
    for file, of_file in reached.items():
        inner = [
            f" {json.dumps(name)}: {json.dumps(sorted(number[t] for t in of if t in number), separators=(',', ':'))}"
            for name, of in of_file.items()
        ]
        parts.append(f"{json.dumps(file)}: {{\n" + ",\n".join(inner) + "\n}")
    lines += [",\n".join(parts), "}", "}"]
    return "\n".join(lines) + "\n"
