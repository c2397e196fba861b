"""`orthocapture runs`, `compare` and `history`: find runs and compare them."""

from __future__ import annotations

from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from service.audit.comparison import ComparedRun, RunComparison, compare_runs
from service.audit.filters import RESULTS, RunSearch
from service.audit.queries import plain
from service.audit.runs import RESULT_WORDS, FoundRun, find_runs, history, history_csv
from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    console,
    print_document,
    print_json,
    print_table,
    reporting_errors,
    require_writable,
    write_whole,
)
from service.core.measure_names import measure_name
from service.core.words import counted
from service.followed_run import read_log
from service.run_start import recorded_run
from service.store.store import Store


def runs_command(
    search: Annotated[
        str,
        typer.Option("--search", help="Words in specimen, purpose, site, people, remarks, notes or protocol."),
    ] = "",
    since: Annotated[str, typer.Option("--since", help="First day, such as 2026-11-21.", metavar="DAY")] = "",
    until: Annotated[str, typer.Option("--until", help="Last day.", metavar="DAY")] = "",
    result: Annotated[str, typer.Option("--result", help=f"One of {', '.join(RESULTS)}.")] = "",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """List the recorded runs, newest first: all, or those that match."""
    if result and result not in RESULTS:
        raise typer.BadParameter(f"{result!r} is not one of {', '.join(RESULTS)}", param_hint="--result")
    wanted = RunSearch(q=plain(search), since=_day(since, "--since"), until=_day(until, "--until"), result=result)
    with reporting_errors(json), Store.open(data, create=False) as store:
        found = find_runs(store, wanted)
    if json:
        print_json([_record(run) for run in found])
        return
    if not found:
        console.print("No run matches." if wanted.active else "No run has been recorded here yet.")
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("run", "started (UTC)", "specimen", "purpose", "protocol", "by", "result"):
        table.add_column(heading)
    for run in found:
        basics, about = run.basics, run.basics.about
        cells = (about.specimen, about.purpose, f"{basics.protocol} {basics.version}", by(run), result_words(run))
        table.add_row(basics.run_id, basics.created_utc[:16].replace("T", " "), *cells)
    print_table(table)


def by(run: FoundRun) -> str:
    """Return who worked at the rig or, if that was not given, who started the run."""
    return run.basics.about.operator or run.basics.operator


def result_words(run: FoundRun) -> str:
    """Return a run's result as text, such as `completed, 0.213 mm (within), released`."""
    words = [RESULT_WORDS[run.status]]
    if run.accuracy is not None:
        words.append(run.accuracy.words)
    words += ["released"] if run.released else []
    return ", ".join(words) + (" · simulated" if run.basics.simulated else "")


def _record(run: FoundRun) -> dict[str, object]:
    basics = run.basics
    return {
        "run": basics.run_id,
        "created_utc": basics.created_utc,
        "simulated": basics.simulated,
        "protocol": basics.protocol,
        "version": basics.version,
        "begun_by": basics.operator,
        "about": basics.about.model_dump(),
        "notes": list(run.notes),
        "status": run.status,
        "released": run.released,
        "accuracy": None if run.accuracy is None else asdict(run.accuracy),
    }


def _day(given: str, option: str) -> str:
    try:
        return date.fromisoformat(given).isoformat() if given else ""
    except ValueError as error:
        raise typer.BadParameter(f"{given!r} is not a day such as 2026-11-21", param_hint=option) from error


def compare_command(
    first: Annotated[str, typer.Argument(help="A run: its name, its first characters, or `latest`.")],
    second: Annotated[str, typer.Argument(help="The run to compare it with.")],
    everything: Annotated[bool, typer.Option("--all", help="Also show what is the same in both.")] = False,
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Compare two runs: protocol, gates, figures, accuracy, calibration, durations, deviations."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        comparison = compare_runs(_compared(store, first), _compared(store, second))
    if json:
        print_json(_comparison_record(comparison))
        return
    one, other = comparison.first.run_id, comparison.second.run_id
    if comparison.same_protocol:
        console.print(f"The same protocol, SHA-256 {comparison.first.root.protocol_sha256}")
    else:
        console.print(f"{len(comparison.protocol_changes)} lines of the protocol differ (− {one}, + {other}):")
        for line in comparison.protocol_changes:
            console.print(f"  {line}")
    for part in _PARTS:
        rows = [row for row in getattr(comparison, part) if everything or row.differs]
        if not rows:
            continue
        table = Table(title=part.capitalize(), title_justify="left", box=None, pad_edge=False)
        for heading in ("", one, other, "change"):
            table.add_column(heading)
        for row in rows:
            named = measure_name(row.name) if part in ("gates", "measures") else row.name.replace("_", " ")
            name = " ".join(filter(None, (row.step, named)))
            table.add_row(name, row.first, row.second, row.change)
        print_table(table)
    for run_id, lines in zip((one, other), comparison.deviations, strict=True):
        console.print(f"Deviations of {run_id}: {len(lines) or 'none'}")
        for line in lines:
            console.print(f"  {line}")


_PARTS = ("about", "accuracy", "gates", "calibration", "durations", "measures")


def _compared(store: Store, name: str) -> ComparedRun:
    run_id = store.find_run(name)
    protocol, _ = recorded_run(store, run_id)
    return ComparedRun.of(read_log(store, run_id, protocol))


def _comparison_record(comparison: RunComparison) -> dict[str, object]:
    parts = {part: [asdict(row) for row in getattr(comparison, part)] for part in _PARTS}
    return {
        "first": comparison.first.run_id,
        "second": comparison.second.run_id,
        "same_protocol": comparison.same_protocol,
        "protocol_changes": list(comparison.protocol_changes),
        **parts,
        "deviations": [list(lines) for lines in comparison.deviations],
    }


def history_command(
    out: Annotated[Path | None, typer.Option("--out", help="Write into this file.", dir_okay=False)] = None,
    data: DataOption = DEFAULT_DATA,
) -> None:
    """Print calibration and accuracy over time for each camera, lens and arm, as CSV."""
    with reporting_errors(), Store.open(data, create=False) as store:
        if out is not None:
            require_writable(out)
        rows = history(store)
        content = history_csv(rows)
    if out is None:
        print_document(content)
        return
    with reporting_errors():
        write_whole(out, content)
    console.print(f"{counted(len(rows), 'run')} with figures: {out!s}")
