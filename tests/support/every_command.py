"""Every command of the program, as its command line knows them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer
from typer.core import TyperGroup

from service.cli.main import app


def every_command() -> Iterator[tuple[str, Any]]:
    """All commands and groups with their names, such as `audit show`; that of the program itself is empty."""
    yield from _below("", typer.main.get_command(app))


def _below(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield name, command
    if isinstance(command, TyperGroup):
        context = typer.Context(command)
        for each in command.list_commands(context):
            yield from _below(f"{name} {each}".strip(), command.resolve_command(context, [each])[1])
