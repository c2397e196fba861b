"""`orthocapture simulate`: becomes a simulator process; this package imports none of them."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from typing import Annotated, Any

import typer

from service.core.errors import OrthocaptureError

_SIMULATORS = (sys.executable, "-m", "simulators")


def simulate_command(context: typer.Context) -> None:
    """Start a simulated device (ur, camera, scanner, ct, lightbox) or a whole rig, until it is terminated.

    It prints one line of JSON with its addresses when it is ready. `orthocapture simulate rig --help` lists options.
    """
    words = context.args
    if words and not {"--help", "-h"} & set(words):
        os.execv(sys.executable, [*_SIMULATORS, *words])
    chosen = next((word for word in words if not word.startswith("-")), "")
    described = _described(chosen)
    name = chosen if "options" in described else "simulate"
    app = _one(described) if "options" in described else _all(described["simulators"], context.command.help or "")
    # In the style of every other command, though a simulator declares its options by itself.
    command = typer.main.get_command(app)
    with command.make_context(name, ["--help"], parent=context.parent, resilient_parsing=True) as shown:
        typer.echo(command.get_help(shown), nl=False)


def _described(name: str) -> dict[str, Any]:
    done = subprocess.run([*_SIMULATORS, "--describe", name], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OrthocaptureError("the simulators do not start", where=done.stderr[-300:], remedy="Install them again")
    return json.loads(done.stdout)


def _one(described: dict[str, Any]) -> typer.Typer:
    def shown(**_: object) -> None:
        """Never called: only its options are shown."""

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
    if option["choices"]:
        words += f" One of {', '.join(option['choices'])}."
    if option["default"]:
        words += f" Without: {option['default']}."
    flags = option["flags"]
    kind = bool if option["flag"] else str | None
    declared = typer.Option(*flags, metavar=None if option["flag"] else option["metavar"] or None, help=words)
    return inspect.Parameter(
        flags[-1].lstrip("-").replace("-", "_"),
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if option["required"] else False if option["flag"] else None,
        annotation=Annotated[kind, declared],
    )


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:]}." if words else ""
