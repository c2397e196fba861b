"""`orthocapture worker`: serve registration jobs of a data folder."""

from __future__ import annotations

import os
import signal
from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
)
from service.store.store import Store
from service.worker.loop import work


def worker_command(
    data: DataOption = DEFAULT_DATA,
    until_idle: Annotated[bool, typer.Option("--until-idle", help="End when no job is left.")] = False,
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
    json: JsonOption = False,
) -> None:
    """Compute: calibration, spheres, structure from motion, registration. Start as many as you have cores for."""
    parent = os.getppid()
    stopped = False

    def on_terminate(_signal: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, on_terminate)
    with reporting_errors(json), Store.open(data) as store, progress_bar(quiet=json) as progress:
        done = work(
            store,
            until_idle=until_idle,
            stop=lambda: stopped or (with_parent and os.getppid() != parent),
            progress=progress,
        )
        if json:
            print_json({"jobs": done})
        elif not with_parent:
            console.print(f"{done} jobs done")
