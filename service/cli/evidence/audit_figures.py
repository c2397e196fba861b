"""`orthocapture audit figures`: the figures of a report as SVG for print, and their data as CSV."""

from __future__ import annotations

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
    require_writable_folder,
)
from service.core.errors import ConfigurationError
from service.core.text.counts import counted
from service.store.runs import resolve_run
from service.store.verification import verify as audit


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
            verified = audit.verify(data, run_id, progress)
            if not verified.ok:
                error_console.tell(("The evidence does NOT verify:", "bold red"), f" {verified.first_fault}")
                raise typer.Exit(1)
            # The numerics take a second to load, and `audit verify` does not need them.
            from service.audit.record.run import read_run  # noqa: PLC0415
            from service.audit.report.content import report_content  # noqa: PLC0415
            from service.audit.report.output.figures import figure_files, write_figures  # noqa: PLC0415

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
