"""`orthocapture runs`, `compare` and `history`: finding runs, and holding them against one another."""

from __future__ import annotations

from dataclasses import asdict
from datetime import date
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from service.audit.run_search import RESULT_WORDS, RESULTS, FoundRun, RunWanted, find_runs
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_json,
    print_table,
    reporting_errors,
)
from service.store.store import Store


def runs_command(
    search: Annotated[
        str,
        typer.Option("--search", help="Words of specimen, purpose, site, people, remarks, notes or protocol."),
    ] = "",
    since: Annotated[str, typer.Option("--since", help="First day, as 2026-11-21.", metavar="DAY")] = "",
    until: Annotated[str, typer.Option("--until", help="Last day.", metavar="DAY")] = "",
    result: Annotated[str, typer.Option("--result", help=f"One of {', '.join(RESULTS)}.")] = "",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """List the recorded runs, newest first; all of them, or those that fit."""
    if result and result not in RESULTS:
        raise typer.BadParameter(f"{result!r} is none of {', '.join(RESULTS)}", param_hint="--result")
    wanted = RunWanted(search, _day(since, "--since"), _day(until, "--until"), result)
    with reporting_errors(json), Store.open(data, create=False) as store:
        found = find_runs(store, wanted)
    if json:
        print_json([_record(run) for run in found])
        return
    if not found:
        console.print("No run fits." if wanted.active else "No run has been recorded here yet.")
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("run", "begun (UTC)", "specimen", "purpose", "protocol", "by", "result"):
        table.add_column(heading)
    for run in found:
        cells = (run.about.specimen, run.about.purpose, f"{run.protocol} {run.version}", by(run), result_words(run))
        table.add_row(run.run_id, run.created_utc[:16].replace("T", " "), *map(escape, cells))
    print_table(table)


def by(run: FoundRun) -> str:
    """Who worked at the rig, or at least who began the run."""
    return run.about.operator or run.begun_by


def result_words(run: FoundRun) -> str:
    """`completed, 0.213 mm (within), released`."""
    words = [RESULT_WORDS[run.status]]
    if run.accuracy is not None:
        words.append(run.accuracy.words)
    return ", ".join([*words, *(["released"] if run.released else [])]) + (" · simulated" if run.simulated else "")


def _record(run: FoundRun) -> dict[str, object]:
    return {
        "run": run.run_id,
        "created_utc": run.created_utc,
        "simulated": run.simulated,
        "protocol": run.protocol,
        "version": run.version,
        "begun_by": run.begun_by,
        "about": run.about.model_dump(),
        "notes": list(run.notes),
        "status": run.status,
        "released": run.released,
        "accuracy": None if run.accuracy is None else asdict(run.accuracy),
    }


def _day(given: str, option: str) -> str:
    try:
        return date.fromisoformat(given).isoformat() if given else ""
    except ValueError as error:
        raise typer.BadParameter(f"{given!r} is no day such as 2026-11-21", param_hint=option) from error
