"""The page of the command line: every command with its arguments, options and defaults."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import typer

from service.cli.ending import MEANINGS
from service.cli.main import app

_HEAD = """\
Made from the code by `make reference`.

Errors say what is wrong, where, and what to do; with `--json` the answer is one JSON object on the last line of the
standard output.

## Exit statuses
"""


def commands_text() -> str:
    """A Markdown page."""
    group: Any = typer.main.get_command(app)
    context = group.make_context("orthocapture", [], resilient_parsing=True)
    lines = ["# The command line", "", _HEAD, "| status | meaning |", "|---:|---|"]
    lines += [*(f"| {status.value} | {meaning} |" for status, meaning in MEANINGS.items()), ""]
    for name in group.list_commands(context):
        _, command, _ = group.resolve_command(typer.Context(group), [name])
        lines += _command(f"orthocapture {name}", command)
    return "\n".join(lines)


def _command(path: str, command: Any) -> Iterator[str]:
    below = getattr(command, "commands", None)
    yield from (f"## {path}", "", inspect.cleandoc(command.help or ""), "")
    if below:
        for name, inner in below.items():
            yield from _command(f"{path} {name}", inner)
        return
    if path.endswith(" simulate"):
        yield from ("`orthocapture simulate NAME --help` lists the options of one simulator.", "")
        return
    rows = [_row(one) for one in command.params if not getattr(one, "hidden", False) and one.name != "help"]
    yield from (["| | default | meaning |", "|---|---|---|", *rows, ""] if rows else [])


def _row(one: Any) -> str:
    option = one.param_type_name == "option"
    names = ", ".join(f"`{name}`" for name in [*one.opts, *one.secondary_opts]) if option else f"`{_argument(one)}`"
    return f"| {names} | {_default(one)} | {(one.help or '').replace('|', '/')} |"


def _argument(one: Any) -> str:
    return one.metavar or one.name.upper()


def _default(one: Any) -> str:
    shown = getattr(one, "show_default", None)
    if isinstance(shown, str):
        return shown
    if one.required:
        return "required"
    value = one.default
    if callable(value) or value in (None, "", (), []):
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"`{getattr(value, 'value', value)}`"
