"""Options of commands that can compute on a cluster: the scheduler's address, and the files to reach it by tls."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.core.errors import ConfigurationError
from service.machine.executors import VARIABLE

if TYPE_CHECKING:
    from service.machine.schedulers import Scheduler

PATIENCE_S = 30.0

SchedulerOption = Annotated[
    str,
    typer.Option(
        "--scheduler",
        envvar=VARIABLE,
        help="tcp://host:port or tls://host:port of a Dask scheduler, whose workers compute what is parallel "
        "inside a job; default: processes of this machine.",
    ),
]
SchedulerCaOption = Annotated[
    Path | None,
    typer.Option(
        "--scheduler-ca",
        envvar=f"{VARIABLE}_CA",
        help="For tls: the certificate of the authority that signed the others.",
    ),
]
SchedulerCertOption = Annotated[
    Path | None,
    typer.Option("--scheduler-cert", envvar=f"{VARIABLE}_CERT", help="For tls: the certificate of this machine."),
]
SchedulerKeyOption = Annotated[
    Path | None,
    typer.Option("--scheduler-key", envvar=f"{VARIABLE}_KEY", help="For tls: the key of this machine's certificate."),
]
SchedulerPatienceOption = Annotated[
    float,
    typer.Option(
        "--scheduler-patience",
        min=1,
        help="Seconds without an answer or a worker, after which this machine computes the rest.",
    ),
]


def reached_scheduler(
    address: str, *, ca: Path | None, cert: Path | None, key: Path | None, patience_s: float
) -> Scheduler | None:
    """Return the scheduler of the options after a connection to it was tried; None if none is given.

    Raises ConfigurationError: the options contradict each other, no scheduler or worker answers, or versions differ.
    """
    if not address:
        if any(file is not None for file in (ca, cert, key)):
            raise ConfigurationError("files for a scheduler are given, but no --scheduler", remedy="Give its address")
        return None
    from service.machine.schedulers import RemoteExecutors, Scheduler  # noqa: PLC0415 - few have a cluster

    scheduler = Scheduler(address, ca, cert, key, patience_s)
    executors = RemoteExecutors(scheduler)
    try:
        executors.connect()
    finally:
        executors.close()
    return scheduler
