"""`orthocapture worker`: compute the jobs of a data folder."""

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
from service.cli.scheduler import (
    PATIENCE_S,
    SchedulerCaOption,
    SchedulerCertOption,
    SchedulerKeyOption,
    SchedulerOption,
    SchedulerPatienceOption,
    reached_scheduler,
)
from service.computations import job_kinds
from service.core.errors import ConfigurationError
from service.core.words import counted
from service.logs import file_log
from service.store.data_folder import kept_to
from service.worker.pool import work_side_by_side
from service.worker.uploading import uploading


def worker_command(
    data: DataOption = DEFAULT_DATA,
    until_idle: Annotated[bool, typer.Option("--until-idle", help="End when no job is left.")] = False,
    jobs: Annotated[
        int, typer.Option("--jobs", min=0, help="Number of jobs to compute at once; 0: one per core.")
    ] = 0,
    kinds: Annotated[
        str,
        typer.Option(
            metavar="KIND[,KIND…]", help="Compute only jobs of these kinds, such as features,match; default: all."
        ),
    ] = "",
    scheduler: SchedulerOption = "",
    scheduler_ca: SchedulerCaOption = None,
    scheduler_cert: SchedulerCertOption = None,
    scheduler_key: SchedulerKeyOption = None,
    scheduler_patience: SchedulerPatienceOption = PATIENCE_S,
    parent: Annotated[
        int, typer.Option("--parent", hidden=True, help="End when this process is not the parent.")
    ] = 0,
    json: JsonOption = False,
) -> None:
    """Compute jobs: calibration, spheres, structure from motion, registration; one job per core at once."""
    stopped = False

    def on_terminate(_signal: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGTERM, on_terminate)
    with (
        reporting_errors(json),
        kept_to(data),
        file_log(data, "worker"),
        uploading(data),
        progress_bar(quiet=json) as progress,
    ):
        chosen = _kinds(kinds)
        cluster = reached_scheduler(
            scheduler, ca=scheduler_ca, cert=scheduler_cert, key=scheduler_key, patience_s=scheduler_patience
        )
        done = work_side_by_side(
            data,
            at_once=jobs or os.cpu_count() or 1,
            until_idle=until_idle,
            stop=lambda: stopped or (parent != 0 and os.getppid() != parent),
            progress=progress,
            scheduler=cluster,
            kinds=chosen,
        )
        if json:
            print_json({"jobs": done})
        elif not parent:
            console.print(f"{counted(done, 'job')} done")


def _kinds(text: str) -> tuple[str, ...] | None:
    """Return the kinds of the option; None without it. Raises ConfigurationError if one does not exist."""
    if not text:
        return None
    kinds = tuple(name.strip() for name in text.split(","))
    unknown = sorted(set(kinds) - set(job_kinds()))
    if unknown:
        raise ConfigurationError(
            f"there is no kind of job called {unknown[0]!r}",
            where="--kinds",
            remedy=f"Choose among {', '.join(job_kinds())}",
        )
    return kinds
