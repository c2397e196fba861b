"""`orthocapture audit report` and `figures`: write a report of a run, or its figures, for readers outside."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    RunArgument,
    console,
    error_console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable,
    require_writable_folder,
)
from service.cli.exit_status import ExitStatus
from service.cli.options import OperatorOption, PasswordOption, acting_name
from service.core.errors import ConfigurationError
from service.core.words import counted
from service.store.database.engine import database_path
from service.store.runs import resolve_run
from service.store.store import Store
from service.store.verification import verify as audit


def report_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    pdf: Annotated[
        Path | None, typer.Option("--pdf", metavar="FILE", help="Write it as PDF.", dir_okay=False)
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            "--html", metavar="FILE", help="Write it as one HTML file, with the scene in 3D.", dir_okay=False
        ),
    ] = None,
    operator: OperatorOption = "",
    password_stdin: PasswordOption = False,
    json: JsonOption = False,
) -> None:
    """Write a report of a run: deviations, accuracy, gates, signatures, certificates, pictures, verification.

    The evidence is verified first. If it does not verify, the exit status is 1 and the report says so at the top.
    The report is recorded in the run, unless the evidence does not verify or the folder is read-only.
    A run that is not yet released can be reported as well; the report says so.
    """
    with reporting_errors(json):
        if pdf is None and html is None:
            raise ConfigurationError("no file to write", remedy="Give --pdf FILE, --html FILE, or both")
        for path in (pdf, html):
            if path is not None:
                require_writable(path)
        run_id = resolve_run(audit.list_runs(data), run)
        actor = acting_name(data, operator, "report", password_stdin=password_stdin) if _writable(data) else ""
        with progress_bar(quiet=json) as progress:
            verified = audit.verify(data, run_id, progress).with_limits()
            # Numerics, pictures and fonts take a second to load, and `audit verify` does not need them.
            from service.audit.recorded_run import read_run  # noqa: PLC0415
            from service.audit.report import report_content  # noqa: PLC0415
            from service.audit.report_output import write_html, write_pdf  # noqa: PLC0415

            progress("writing the report", 0, 1)
            report = report_content(read_run(data, run_id), verified, with_scene=html is not None)
            recorded = verified.ok and bool(actor)
            for path, write in ((pdf, write_pdf), (html, write_html)):
                if path is not None:
                    leave = partial(_record, data, run_id, report.head_sha256, actor)
                    _write(path, partial(write, report), leave if recorded else None)
    written = [str(path) for path in (pdf, html) if path is not None]
    if json:
        print_json(
            {
                "run": run_id,
                "verified": verified.ok,
                "written": written,
                "recorded": recorded,
                "head": report.head_sha256,
            }
        )
    else:
        console.print(f"Report of run {run_id}: {', '.join(written)}")
        if not recorded:
            why = "its evidence does not verify" if not verified.ok else "the data folder is read-only"
            console.print(f"  The report is not recorded in the run, because {why}.")
    if not verified.ok:
        if not json:
            error_console.tell(("The evidence does NOT verify:", "bold red"), f" {verified.first_fault}")
        raise typer.Exit(ExitStatus.FAILED)


def _write(path: Path, write: Callable[[Path], None], leave: Callable[[Path, str], None] | None) -> None:
    """Write a file under a temporary name and rename it once recorded; if recording fails, no report appears."""
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".report-") as folder:
            part = Path(folder) / path.name
            write(part)
            if leave is not None:
                leave(part, path.name)
            part.replace(path)
    except OSError as error:
        raise ConfigurationError(
            f"the report cannot be written: {error.strerror}", where=str(error.filename or path)
        ) from error


def _record(data: Path, run_id: str, head_sha256: str, actor: str, part: Path, file_name: str) -> None:
    from service.audit.bundle import record_export  # noqa: PLC0415  # loads the numerics

    with Store.open(data, create=False) as store:
        record_export(store, run_id, part, file_name=file_name, what="report", head_sha256=head_sha256, actor=actor)


def _writable(data: Path) -> bool:
    """Return whether anything can be recorded; an auditor's copy may be on a read-only medium."""
    path = database_path(data)
    return os.access(data, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))


def figures_command(
    run: RunArgument = "latest",
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files.", file_okay=False)] = Path(
        "figures"
    ),
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Write every figure of a run's report as SVG and its data as CSV, with the tables of errors.

    File names begin with the number of the report's section. The evidence is verified first; if it does not verify,
    nothing is written and the exit status is 1.
    """
    with reporting_errors(json):
        require_writable_folder(out)
        run_id = resolve_run(audit.list_runs(data), run)
        with progress_bar(quiet=json) as progress:
            verified = audit.verify(data, run_id, progress).with_limits()
            if not verified.ok:
                error_console.tell(("The evidence does NOT verify:", "bold red"), f" {verified.first_fault}")
                raise typer.Exit(ExitStatus.FAILED)
            # The numerics take a second to load, and `audit verify` does not need them.
            from service.audit.recorded_run import read_run  # noqa: PLC0415
            from service.audit.report import report_content  # noqa: PLC0415
            from service.audit.report_output import figure_files, write_figures  # noqa: PLC0415

            progress("drawing the figures", 0, 1)
            recorded = read_run(data, run_id)
            files = figure_files(report_content(recorded, verified, with_scene=False), recorded.summary())
            try:
                write_figures(files, out)
            except OSError as error:
                raise ConfigurationError(
                    f"the figures cannot be written: {error.strerror}", where=str(error.filename or out)
                ) from error
    if json:
        listed = [{"name": file.name, "shows": file.shows} for file in files]
        print_json({"run": run_id, "folder": str(out), "files": listed})
        return
    if not files:
        console.print(f"Run {run_id} has no figure yet: nothing was calibrated, registered or evaluated.")
        return
    console.print(f"{counted(len(files), 'file')} of run {run_id} in {out!s}:")
    for file in files:
        console.print(f"  {file.name}: {file.shows}")
