"""Benches use what tests do, and tests nothing of a bench: what both need is in tests/support."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]


def imported_modules(source: str) -> Iterator[str]:
    """Yield the modules that a source imports, wherever in it the import stands."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def test_tests_import_nothing_from_a_bench() -> None:
    sources = {path: path.read_text("utf-8") for path in (REPOSITORY / "tests").rglob("*.py")}
    found = {
        path.relative_to(REPOSITORY).as_posix(): modules
        for path, source in sources.items()
        if "bench" in source
        if (modules := [name for name in imported_modules(source) if name.partition(".")[0] == "bench"])
    }
    assert not found, "move what both need to tests/support, or run the script: python -m bench…"


def test_an_import_within_a_function_is_found() -> None:
    assert list(imported_modules("def test():\n    from bench.machine import commit\n    import os\n")) == [
        "bench.machine",
        "os",
    ]
