"""A command ends with a status of the table in service/cli/ending.py, by its name and not by its number."""

from __future__ import annotations

import ast
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
ENDS = {"typer.Exit", "Exit", "sys.exit", "SystemExit"}


def numbered_exits(source: str) -> list[int]:
    """Return the lines of a module that end the program with a number."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [
        call.lineno
        for call in calls
        if ast.unparse(call.func) in ENDS
        for value in [*call.args, *(keyword.value for keyword in call.keywords)]
        if isinstance(value, ast.Constant) and isinstance(value.value, int)
    ]


def test_no_command_ends_with_a_number() -> None:
    found = {
        path.name: lines
        for path in sorted((REPOSITORY / "service" / "cli").rglob("*.py"))
        if (lines := numbered_exits(path.read_text("utf-8")))
    }
    assert not found, "name the status: typer.Exit(ExitStatus.FAILED)"


def test_numbers_are_found_in_every_way_of_ending() -> None:
    source = "raise typer.Exit(1)\nraise typer.Exit(code=2)\nsys.exit(1)\nraise SystemExit(0)\nsys.exit(main())\n"
    assert numbered_exits(source) == [1, 2, 3, 4]
    assert numbered_exits("raise typer.Exit(ExitStatus.FAILED)\nraise typer.Exit()\n") == []
