"""`orthocapture worker` and `dicom-listen`: compute jobs, and receive what a CT suite sends, until terminated."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    only_here,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable_folder,
)
from service.cli.ending import stop_requested
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
from service.core.units import bytes_of_gigabytes
from service.core.words import counted
from service.logs import file_log
from service.store.data_folder import kept_to
from service.worker.pool import uploading, work_side_by_side

# --- `worker`: compute the jobs of a data folder ------------------------------------------------------------------


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


# --- `dicom-listen`: receive the series that a CT suite sends, into the folder of the rig's CT --------------------


def dicom_listen_command(
    folder: Annotated[
        Path, typer.Option("--folder", metavar="DIR", help="Where series go: the folder of the rig's dicom_folder.")
    ],
    ae_title: Annotated[str, typer.Option("--ae-title", help="The AE title of this program.")] = "ORTHOCAPTURE",
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", help="Port to listen on; 0 takes a free one.", min=0, max=65535)
    ] = 11112,
    callers: Annotated[
        list[str] | None,
        typer.Option("--from", metavar="TITLE", help="AE title that may send; may be repeated. Default: any."),
    ] = None,
    reserve_gb: Annotated[
        float, typer.Option("--reserve-gb", help="Space that stays free on the disk.", min=0.0)
    ] = 1.0,
    json: JsonOption = False,
) -> None:
    """Receive CT series and segmentations that a CT suite sends (DICOM C-STORE), until it is terminated.

    A series appears in the folder when its sender has finished; the rig's CT then reads it from there.
    """
    from drivers.dicom_receiver import Receiver, ReceiverConfig  # noqa: PLC0415 - pydicom, which a worker does without

    with reporting_errors(json):
        if not only_here(host) and not callers:
            raise ConfigurationError(
                f"{host} is reachable from other machines, and any caller may send",
                where="--host",
                remedy="Name the AE titles that may send with --from. A title is not a password: also restrict the "
                "port to the CT suite in the firewall",
            )
        require_writable_folder(folder)
        folder.mkdir(exist_ok=True)
        config = ReceiverConfig(folder, ae_title, host, port, tuple(callers or ()), bytes_of_gigabytes(reserve_gb))
        told = threading.Lock()

        def tell(text: str) -> None:
            with told:
                if json:
                    print_json({"told": text})
                else:
                    console.print(text)

        with stop_requested() as stopped, Receiver(config, tell) as receiver:
            if json:
                print_json({"ae_title": ae_title, "host": host, "port": receiver.port, "folder": str(folder)})
            else:
                console.print(f"Listening as {ae_title} on {host}:{receiver.port}; series go to {folder}")
            stopped.wait()
