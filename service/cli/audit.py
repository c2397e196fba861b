"""`orthocapture audit`: look at the recorded evidence of a run, and check that nobody has changed it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
)
from service.store import audit
from service.store.audit import AuditReport, EvidenceRecord
from service.store.records import Artefact
from service.store.store import resolve_run

audit_app = typer.Typer(
    name="audit",
    help="Look at the recorded evidence of a run, or check that nothing of it was changed.",
    no_args_is_help=True,
)

_RUN_HELP = "Name of the run, its first characters, or `latest`."


@audit_app.command("show")
def show_command(
    run: Annotated[str, typer.Argument(help=_RUN_HELP)] = "latest",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """List everything that was recorded: what happened, when, by whom, and the files that belong to it."""
    with reporting_errors(json):
        run_id = resolve_run(audit.list_runs(data), run)
        records = audit.show(data, run_id)
        if json:
            print_json({"run": run_id, "events": [_record_json(record) for record in records]})
        else:
            _print_records(run_id, records)


@audit_app.command("verify")
def verify_command(
    run: Annotated[str, typer.Argument(help=_RUN_HELP + " `all` checks every run of the folder.")] = "latest",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Check the evidence: read every file again, follow the chain of records, and name the first fault.

    The exit status is 0 when all is as it was recorded, and 1 when anything differs.
    """
    with reporting_errors(json):
        run_id = None if run == "all" else resolve_run(audit.list_runs(data), run)
        with progress_bar(quiet=json) as report_progress:
            report = audit.verify(data, run_id, report_progress)
    if json:
        print_json(report_json(report))
    else:
        _print_report(report)
    if not report.ok:
        raise typer.Exit(1)


def report_json(report: AuditReport) -> dict[str, Any]:
    """A report as plain data, with `ok` and `first_fault` on top."""
    first = None if report.first_fault is None else {**asdict(report.first_fault), "text": str(report.first_fault)}
    return {"ok": report.ok, "first_fault": first, **asdict(report)}


def _record_json(record: EvidenceRecord) -> dict[str, Any]:
    return {**asdict(record), "artefacts": [_artefact_json(artefact) for artefact in record.artefacts]}


def _artefact_json(artefact: Artefact) -> dict[str, Any]:
    return {
        **artefact.ref.model_dump(),
        "device": artefact.device,
        "step": artefact.step,
        "attempt": artefact.attempt,
        "viewpoint": artefact.viewpoint,
        "who": artefact.who,
        "at_utc": artefact.at_utc,
        "monotonic_s": artefact.monotonic_s,
    }


def _print_records(run_id: str, records: Sequence[EvidenceRecord]) -> None:
    table = Table(title=f"Run {run_id}: {len(records)} events", title_justify="left")
    for heading in ("no.", "time (UTC)", "who", "what", "details"):
        table.add_column(heading, overflow="fold")
    for record in records:
        lines = [escape(record.summary)]
        lines += [
            f"[dim]file[/] {escape(artefact.ref.original_name)} ({artefact.ref.kind}, "
            f"{artefact.ref.size_bytes} bytes, from {escape(artefact.device)}, SHA-256 {artefact.ref.sha256[:12]}…)"
            for artefact in record.artefacts
        ]
        table.add_row(
            str(record.seq),
            record.at_utc[:23].replace("T", " "),
            escape(record.actor),
            record.kind.replace("_", " "),
            "\n".join(line for line in lines if line),
        )
    console.print(table)


def _print_report(report: AuditReport) -> None:
    console.print(
        f"Checked {len(report.runs)} run(s) in {escape(report.data_dir)}: {report.events} events, "
        f"{report.artefacts} recorded files ({report.bytes_hashed / 1e6:.1f} MB read again), {report.jobs} jobs."
    )
    for run_id, head in report.heads.items():
        console.print(f"  {run_id} ends with {head}")
    for note in report.notes:
        console.print(f"  [yellow]note:[/] {escape(note)}")
    if report.first_fault is None:
        console.print("[bold green]Verified:[/] everything is as it was recorded.")
        return
    console.print(f"[bold red]NOT verified.[/] First fault: {escape(str(report.first_fault))}")
    if len(report.faults) > 1:
        console.print(f"  and {len(report.faults) - 1} more; all of them with --json")
    console.print("  Keep this folder as it is, and compare it with a copy made earlier.")
