"""`orthocapture replay`: compute a run's results again and compare them with the record."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from service.audit.differences import Difference
from service.audit.recorded_run import read_run
from service.audit.replay import DEFAULT_KINDS, JobReplay, ReplayReport, replay
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    RunArgument,
    console,
    fail,
    print_json,
    print_table,
    progress_bar,
    require_writable_folder,
    write_whole,
)
from service.cli.ending import ExitStatus
from service.cli.terminal_output import styled
from service.computations import term
from service.core.errors import OrthocaptureError
from service.core.gates import describe
from service.core.units import megabytes
from service.worker.loop import HANDLERS

_STATUS = {
    "identical": ExitStatus.DONE,
    "within_tolerance": ExitStatus.DONE,
    "different": ExitStatus.FAILED,
    "not_replayed": ExitStatus.NOT_POSSIBLE,
}
_SHOWN = 8  # most differences shown per job
_WORDS = {
    "identical": ("equal, bit for bit", "bold green"),
    "within_tolerance": ("equal within rounding (1e-9)", "bold green"),
    "different": ("different", "bold yellow"),
    "not_replayed": ("could not be replayed", "bold red"),
}


def replay_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    step: Annotated[str | None, typer.Option("--step", help="Only the jobs of this step.")] = None,
    jobs: Annotated[
        str,
        typer.Option(
            "--jobs",
            metavar="KINDS",
            help="Kinds of jobs, separated by commas: calibrate,register. `all` adds the checks of each live image.",
        ),
    ] = ",".join(DEFAULT_KINDS),
    end_to_end: Annotated[
        bool,
        typer.Option(
            "--end-to-end", help="Feed each job the recomputed results of earlier jobs, and report the drift."
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Keep the recomputed files and replay.json in this folder.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compute calibration, registration and evaluation again from the recorded files, and compare.

    The recorded parameters are used, and nothing is written into the evidence. The exit status is 0 if everything is
    equal, 1 if something differs, and 2 if the run could not be replayed.
    """
    try:
        kinds = list(HANDLERS) if jobs == "all" else [kind.strip() for kind in jobs.split(",") if kind.strip()]
        if out is not None:
            require_writable_folder(out)
        recorded = read_run(data, run)
        with progress_bar(quiet=json) as progress:
            report = replay(recorded, kinds=kinds, step=step, end_to_end=end_to_end, out=out, progress=progress)
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            text = json_module.dumps(report_json(report), indent=1, ensure_ascii=False, allow_nan=False)
            write_whole(out / "replay.json", text + "\n")
    except OrthocaptureError as error:
        fail(error, json=json)  # only prints; its exit status 1 would mean a difference
        raise typer.Exit(ExitStatus.NOT_POSSIBLE) from error
    if json:
        print_json(report_json(report))
    else:
        _print(report)
    raise typer.Exit(_STATUS[report.verdict])


def report_json(report: ReplayReport) -> dict[str, Any]:
    """Return a replay report as plain data, with the verdicts added."""
    plain: dict[str, Any] = {"verdict": report.verdict, **asdict(report)}
    for job, shown in zip(report.jobs, plain["jobs"], strict=True):
        shown["differences"] = [_plain(difference) for difference in job.differences]
        for part in ("measures", "result"):
            shown[part] = {"compared": shown[part]["compared"], "identical": not shown[part]["differences"]}
        for artefact in shown["artefacts"]:
            artefact["identical"] = artefact["recorded_sha256"] == artefact["recomputed_sha256"]
            del artefact["content"]
    for gate, shown in zip(report.gates, plain["gates"], strict=True):
        shown["recorded"] = [verdict.model_dump() for verdict in gate.recorded]
        shown["recomputed"] = [verdict.model_dump() for verdict in gate.recomputed]
        shown["changed"] = [describe(new) for _, new in gate.changed]
    return plain


def _plain(difference: Difference) -> dict[str, Any]:
    """Return a difference as plain data, with None for infinities, which JSON does not have."""
    plain = {**asdict(difference), "within_tolerance": difference.within_tolerance}
    for name in ("difference", "relative"):
        if plain[name] == float("inf"):
            plain[name] = None
    return plain


def _print(report: ReplayReport) -> None:
    console.print(f"Replay of run {report.run_id}, whose chain ends with {report.head_sha256}")
    console.print(
        f"Evidence verified first: {report.files_verified} files, "
        f"{megabytes(report.bytes_verified):.1f} MB read again."
    )
    _print_versions(report)
    _print_table(report)
    for job in report.jobs:
        if job.error or job.differences or job.computed_by:
            _print_job(job)
    _print_gates(report)
    for drift in report.drifts:
        world = "" if drift.in_world_mm is None else f"{drift.in_world_mm:.6f} mm in the world, "
        console.print(
            f"Drift of {drift.registration} at the scene's centre: {world}"
            f"{drift.against_cameras_mm:.6f} mm against the cameras"
        )
    console.tell(("The run is", "bold"), " ", _WORDS[report.verdict])


def _print_versions(report: ReplayReport) -> None:
    if report.versions:
        console.print(f"{len(report.versions)} installed distributions have other versions than recorded:")
        for change in report.versions:
            console.print(f"  {change.name} {change.recorded or 'none'} → {change.now or 'none'}")
    else:
        console.print("Every installed distribution has the version that was recorded.")


def _print_table(report: ReplayReport) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("step", "computed again", "result", "equal files", "took"):
        table.add_column(heading, justify="right" if heading == "took" else "left", overflow="fold")
    for job in report.jobs:
        same = sum(artefact.recorded_sha256 == artefact.recomputed_sha256 for artefact in job.artefacts)
        table.add_row(
            job.step,
            " ".join(filter(None, (term(job.kind), job.label))),
            styled(_WORDS[job.verdict]),
            f"{same} of {len(job.artefacts)}" if job.artefacts else "",
            f"{job.duration_s:.1f} s",
        )
    print_table(table)


def _print_gates(report: ReplayReport) -> None:
    changed = [(gate.step, old, new) for gate in report.gates for old, new in gate.changed]
    console.print(
        f"Gates: {report.gates_judged} verdicts follow from the recorded measures; with the recomputed measures "
        + (f"these differ ({len(changed)}):" if changed else "none differs.")
    )
    for step, old, new in changed:
        console.print(f"  {step}: {describe(old)} → {describe(new)}")


def _print_job(job: JobReplay) -> None:
    console.print()
    console.tell((f"{job.step}: {job.kind} {job.label}".strip(), "bold"))
    for text in filter(None, (job.computed_by, job.error)):
        console.print(f"  {text}")
    shown: Sequence[Difference] = job.differences[:_SHOWN]
    for d in shown:
        off = [] if d.difference is None else [f"difference {d.difference:.3g} {d.unit}".strip()]
        off += [] if d.relative is None else [f"relative {d.relative:.1e}"]
        off += [f"{d.values} values differ"] if d.values > 1 else []
        console.print(f"  {d.path}: {_value(d.recorded)} → {_value(d.recomputed)}  {', '.join(off)}")
    if len(job.differences) > len(shown):
        console.print(f"  and {len(job.differences) - len(shown)} more fields; all of them with --json")


def _value(value: Any) -> str:
    return f"{value:.12g}" if isinstance(value, float) else str(value)
