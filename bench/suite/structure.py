"""Counts how the code is cut and told: files, folders, records, importers, statements, and turns of phrase.

Everything is read from the syntax trees of the committed files, so that neither the length of a line nor a docstring
that was left out changes a count of statements. `--against COMMIT` counts an earlier commit as well, and prints both.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import statistics
import subprocess
import tarfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import combinations
from pathlib import PurePosixPath
from typing import TypeVar

from bench.machine import REPOSITORY, RESULTS, commit, machine
from tests.support.suite.dialect import PARTICIPLES, PREPOSITIONS, docstrings_of, first_word

ROOMS = ("service", "drivers", "simulators", "bench", "tests")
SHORT_LINES = 40  # a module below it is hardly a subject of its own
SHARED_FIELDS = 4  # records that share so many names of fields may mirror each other

Node = TypeVar("Node", bound=ast.AST)


@dataclass(frozen=True)
class Module:
    """A Python file and its syntax tree."""

    path: PurePosixPath
    text: str
    tree: ast.Module

    @property
    def name(self) -> str:
        """Its dotted name, as others import it."""
        parts = self.path.with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    @property
    def is_init(self) -> bool:
        """Return whether it makes a folder a package."""
        return self.path.name == "__init__.py"

    @property
    def lines(self) -> int:
        """How many lines it has."""
        return len(self.text.splitlines())


def modules_of(revision: str) -> list[Module]:
    """Return the Python files of a commit, parsed."""
    archive = subprocess.run(
        ["git", "archive", "--format=tar", revision, "--", *ROOMS], cwd=REPOSITORY, check=True, capture_output=True
    ).stdout
    found: list[Module] = []
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        for member in files:
            file = files.extractfile(member) if member.isfile() and member.name.endswith(".py") else None
            if file is not None:
                text = file.read().decode("utf-8")
                found.append(Module(PurePosixPath(member.name), text, ast.parse(text)))
    return found


def figures_of(room: str, modules: Iterable[Module]) -> dict[str, float]:
    """Return the figures of one room, by name; `modules` are those of all rooms, which may import it."""
    everything = list(modules)
    own = [m for m in everything if m.path.parts[0] == room]
    bodies = [m for m in own if not m.is_init]
    folders = {m.path.parent for m in own}
    functions = [f for m in own for f in _walk(m, ast.FunctionDef, ast.AsyncFunctionDef)]
    dataclasses, models = _records(own)
    named = Counter(name for m in everything for name in _names(m))
    importers = _importers(everything)
    pairs = sum(len(a & b) >= SHARED_FIELDS for a, b in combinations(dataclasses + models, 2))
    docstrings = [text for m in own for _, text in docstrings_of(ast.walk(m.tree))]
    return {
        "files": len(own),
        "folders": len(folders),
        "deepest folder": max(len(f.parts) for f in folders),
        "__init__.py of at most one line": sum(m.is_init and m.lines <= 1 for m in own),
        "modules": len(bodies),
        "median lines of a module": statistics.median(m.lines for m in bodies),
        f"modules below {SHORT_LINES} lines": sum(m.lines < SHORT_LINES for m in bodies),
        "modules with one importer": sum(len(importers.get(m.name, set())) == 1 for m in bodies),
        "lines of imports": sum(_import_lines(m) for m in own),
        "imports of tests": _imports_of("tests", room, own),
        "imports of bench": _imports_of("bench", room, own),
        "statements": sum(
            isinstance(node, ast.stmt) and not _is_text(node) for m in own for node in ast.walk(m.tree)
        ),
        "functions": len(functions),
        "functions used once": sum(named[f.name] == 1 for f in functions),
        "dataclasses": len(dataclasses),
        "pydantic models": len(models),
        f"pairs of records that share {SHARED_FIELDS} fields": pairs,
        "mappings from str to Any": sum(
            len(re.findall(r"(?:dict|Mapping|MutableMapping)\[str, Any\]", m.text)) for m in own
        ),
        "docstrings": len(docstrings),
        "docstrings that begin with a preposition": sum(
            PREPOSITIONS.fullmatch(first_word(text)) is not None for text in docstrings
        ),
        "functions named by a participle or an adverb": sum(
            PARTICIPLES.fullmatch(f.name) is not None for f in functions
        ),
        "`for one in`": sum(len(re.findall(r"\bfor one in\b", m.text)) for m in own),
    }


def _walk(module: Module, *kinds: type[Node]) -> Iterator[Node]:
    return (node for node in ast.walk(module.tree) if isinstance(node, kinds))


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _import_lines(module: Module) -> int:
    return sum(
        (node.end_lineno or node.lineno) - node.lineno + 1 for node in _walk(module, ast.Import, ast.ImportFrom)
    )


def _imports_of(other: str, room: str, own: Iterable[Module]) -> int:
    if other == room:
        return 0
    return sum((node.module or "").partition(".")[0] == other for m in own for node in _walk(m, ast.ImportFrom))


def _names(module: Module) -> Iterator[str]:
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr


def _importers(modules: Iterable[Module]) -> Mapping[str, set[str]]:
    """Return which modules import each module, in any way."""
    everything = list(modules)
    names = {m.name for m in everything}
    found: dict[str, set[str]] = {}
    for module in everything:
        for node in _walk(module, ast.Import, ast.ImportFrom):
            if isinstance(node, ast.Import):
                targets = {alias.name for alias in node.names}
            else:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                targets = inner & names or {node.module or ""}
            for target in targets & names:
                found.setdefault(target, set()).add(module.name)
    return found


def _records(modules: Iterable[Module]) -> tuple[list[frozenset[str]], list[frozenset[str]]]:
    """Return the names of the fields of each dataclass, and of each pydantic model."""
    classes = [node for m in modules for node in _walk(m, ast.ClassDef)]
    bases = {c.name: {ast.unparse(b).partition("[")[0].rpartition(".")[2] for b in c.bases} for c in classes}
    models = {"BaseModel"}
    while more := {name for name, above in bases.items() if above & models} - models:
        models |= more
    dataclasses: list[frozenset[str]] = []
    pydantic: list[frozenset[str]] = []
    for node in classes:
        annotated = (part.target for part in node.body if isinstance(part, ast.AnnAssign))
        fields = frozenset(target.id for target in annotated if isinstance(target, ast.Name))
        if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
            dataclasses.append(fields)
        elif node.name in models:
            pydantic.append(fields)
    return dataclasses, pydantic


def _table(now: Mapping[str, Mapping[str, float]], before: Mapping[str, Mapping[str, float]]) -> str:
    rows = [f"| | {' | '.join(now)} |", f"|---|{'---:|' * len(now)}"]
    for name in next(iter(now.values())):
        cells = [
            f"{before[room][name]:g} → {now[room][name]:g}" if before else f"{now[room][name]:g}" for room in now
        ]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def main() -> None:
    """Print the figures of HEAD, and record them if wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", metavar="COMMIT", help="an earlier commit, to compare")
    parser.add_argument("--record", action="store_true", help="write them to bench/results")
    options = parser.parse_args()
    now_modules = modules_of("HEAD")
    now = {room: figures_of(room, now_modules) for room in ROOMS}
    before: dict[str, dict[str, float]] = {}
    if options.against:
        modules = modules_of(options.against)
        before = {room: figures_of(room, modules) for room in ROOMS}
    table = _table(now, before)
    print(table)
    if options.record:
        day = datetime.now(UTC).date().isoformat()
        said = f"Commit {commit()}" + (f", compared with {options.against}" if options.against else "")
        stem = RESULTS / f"structure-{day}"
        stem.with_suffix(".md").write_text(f"# How the code is cut and told, {day}\n\n{said}.\n\n{table}\n", "utf-8")
        record = {"day": day, "commit": commit(), "machine": machine(), "now": now, "before": before}
        stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
