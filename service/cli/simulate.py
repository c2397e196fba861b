"""`orthocapture simulate`: replace this process by a simulator; this package imports none of them."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from difflib import get_close_matches
from enum import Enum
from typing import Annotated, Any

import typer

from service.cli.common import print_document
from service.core.errors import OrthocaptureError

_SIMULATORS = (sys.executable, "-m", "simulators")


def simulate_command(context: typer.Context) -> None:
    """Start a simulated device (ur, kuka, camera, gige and others) or a whole rig, until it is terminated.

    It prints one line of JSON with its addresses when it is ready. `orthocapture simulate rig --help` lists options.
    """
    words = context.args
    chosen = words[0] if words and not words[0].startswith("-") else ""
    described = _described(chosen)
    options: list[dict[str, Any]] | None = described.get("options")
    if chosen and options is None:
        near = get_close_matches(chosen, described["simulators"], n=1)
        meant = f"Did you mean {near[0]!r}?" if near else f"There are {', '.join(described['simulators'])}."
        context.fail(f"No such simulator {chosen!r}. {meant}")
    # Show help in the style of the other commands, though simulators declare their own options.
    app = _all(described["simulators"], context.command.help or "") if options is None else _one(described)
    command = typer.main.get_command(app)
    if not words or {"--help", "-h"} & set(words):
        name, parent = (chosen, context) if chosen else ("simulate", context.parent)
        with command.make_context(name, ["--help"], parent=parent, resilient_parsing=True) as shown:
            print_document(command.get_help(shown))
        return
    if options is None:
        context.fail(f"Which one? There are {', '.join(described['simulators'])}.")
    command.make_context(chosen, _one_at_a_time(words[1:], options), parent=context).close()  # refuses wrong usage
    os.execv(sys.executable, [*_SIMULATORS, *words])


def _one_at_a_time(words: list[str], options: list[dict[str, Any]]) -> list[str]:
    """Write `--image A B` as `--image A --image B`, as typer expects several values."""
    many = {flag for option in options if option["many"] for flag in option["flags"]}
    out: list[str] = []
    under = ""
    for word in words:
        if word.startswith("-"):
            under = word if word in many else ""
        elif under and out[-1] != under:
            out.append(under)
        out.append(word)
    return out


def _described(name: str) -> dict[str, Any]:
    done = subprocess.run([*_SIMULATORS, "--describe", name], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OrthocaptureError("the simulators do not start", where=done.stderr[-300:], remedy="Install them again")
    return json.loads(done.stdout)


def _one(described: dict[str, Any]) -> typer.Typer:
    def shown(**_: object) -> None:
        """Never called; it only carries the options."""

    options = [_option(option) for option in described["options"]]
    shown.__signature__ = inspect.Signature(options)  # pyright: ignore[reportFunctionMemberAccess]
    app = typer.Typer(add_completion=False)
    app.command(help=_sentence(described["what"]))(shown)
    return app


def _all(simulators: dict[str, str], words: str) -> typer.Typer:
    app = typer.Typer(add_completion=False, help=words)
    for name, what in simulators.items():
        app.command(name, help=_sentence(what))(lambda: None)
    return app


def _option(option: dict[str, Any]) -> inspect.Parameter:
    words = _sentence(option["help"])
    if option["default"]:
        words += f" Default: {option['default']}."
    flags = option["flags"]
    single: Any = {"int": int, "float": float}.get(option["number"], str)
    if option["choices"]:
        single = Enum("Choice", {choice: choice for choice in option["choices"]})  # typer has no lists of literals
    kind: Any = bool if option["flag"] else list[single] if option["many"] else single | None
    declared = typer.Option(*flags, metavar=None if option["flag"] else option["metavar"] or None, help=words)
    return inspect.Parameter(
        flags[-1].lstrip("-").replace("-", "_"),
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if option["required"] else False if option["flag"] else None,
        annotation=Annotated[kind, declared],
    )


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}." if words else ""
