"""`orthocapture audit report`: a run as a document that a person outside can read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    error_console,
    print_json,
    progress_bar,
    reporting_errors,
)
from service.core.errors import ConfigurationError
from service.store import audit
from service.store.store import resolve_run


def report_command(
    run: Annotated[str, typer.Argument(help="Name of the run, its first characters, or `latest`.")] = "latest",
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
    json: JsonOption = False,
) -> None:
    """Write a report of a run: deviations first, accuracy, gates, signatures, certificates, pictures, verification.

    The evidence is verified first. The exit status is 1 when it does not verify; the report then says so on top.
    """
    with reporting_errors(json):
        if pdf is None and html is None:
            raise ConfigurationError("no file to write", remedy="Say --pdf FILE, --html FILE, or both")
        run_id = resolve_run(audit.list_runs(data), run)
        with progress_bar(quiet=json) as progress:
            verified = audit.verify(data, run_id, progress)
            # Numerics, pictures and fonts take a second to load: `audit verify` must not wait for them.
            from service.audit.recorded import read_run  # noqa: PLC0415
            from service.audit.report_content import report_content  # noqa: PLC0415
            from service.audit.report_html import write_html  # noqa: PLC0415
            from service.audit.report_pdf import write_pdf  # noqa: PLC0415

            progress("writing the report", 0, 1)
            report = report_content(read_run(data, run_id), verified, with_scene=html is not None)
            for path, write in ((pdf, write_pdf), (html, write_html)):
                if path is not None:
                    write(report, path)
    written = [str(path) for path in (pdf, html) if path is not None]
    if json:
        print_json({"run": run_id, "verified": verified.ok, "written": written, "head": report.head_sha256})
    else:
        console.print(f"Report of run {run_id}: {escape(', '.join(written))}")
    if not verified.ok:
        if not json:
            error_console.print(f"[bold red]The evidence does NOT verify:[/] {escape(str(verified.first_fault))}")
        raise typer.Exit(1)
