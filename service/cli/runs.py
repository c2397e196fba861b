"""`orthocapture runs`, `status`, `compare` and `history`: find runs, show how one stands, and compare them."""

from __future__ import annotations

from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    RunArgument,
    console,
    print_document,
    print_json,
    print_table,
    reporting_errors,
    require_writable,
    write_whole,
)
from service.cli.terminal_output import listed
from service.computations.live import LIVE_SUMMARY, LIVE_VIEW, Suggestion
from service.core.gates import Standing, describe, standing
from service.core.measure_names import measure_name
from service.core.records.entered import about_rows
from service.core.records.run_events import GateVerdict
from service.core.recovery import takes_words, ways_on
from service.core.run.expected import tries_words
from service.core.run.state import RunState, StepState, lost_arms
from service.core.words import counted, time_utc
from service.followed_run import read_log
from service.run_record import open_jobs, results_to_come
from service.run_start import recorded_run
from service.steps.coats import coats
from service.steps.live_numbers import describe_view
from service.store.data_folder import SITE_FILE
from service.store.durable_effects import moment_of
from service.store.store import Store

if TYPE_CHECKING:
    from service.store.objects.spool import SpoolLevel

# --- `status`: the state of a run, as a table or as plain data ----------------------------------------------------


def status_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Show the state of a run: steps, gates, deviations."""
    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, root = recorded_run(store, run_id)
        log = read_log(store, run_id, protocol)
        state, missing = log.state, [left.text for left in results_to_come(log)]
        computing = open_jobs(log)
        aging = coats(protocol, state, moment_of(store.clock))
        uploading = _uploading(store)
    if json:
        ways = [asdict(way) for way in ways_on(protocol, state)]
        about = None if root.about is None else root.about.model_dump()
        jobs = [asdict(one) for one in computing]
        aged = [f"{coat.title} {coat.text}" for coat in aging]
        told = {
            "about": about,
            "still_to_come": missing,
            "open_jobs": jobs,
            "coats": aged,
            **({} if uploading is None else {"object_store": asdict(uploading)}),
        }
        print_json(status_record(run_id, state) | told | {"ways_on": ways})
        return
    table = Table(title=f"Run {run_id}: {state.status}", title_justify="left")
    for heading in ("step", "state", "attempt", "views", "gates"):
        table.add_column(heading)
    for step in protocol.steps:
        now = state.steps[step.id]
        gates = listed(*(f"{describe(v)}: {_STANDINGS[_standing(v, now)]}" for v in now.verdicts))
        phase = "skipped" if now.skipped else now.phase.replace("_", " ")
        table.add_row(step.id, phase, str(now.attempt), str(len(now.captured) or ""), gates)
    print_table(table)
    for arm, loss in lost_arms(state).items():
        since = f"the connection to it was lost at {time_utc(loss.since_utc)}, {loss.how}"
        console.print(f"{arm} counts as moving until a person has looked: {since}")
    if words := tries_words(protocol, state):
        console.print(f"trying again: {words}")
    for name, entered in about_rows(root.about):
        console.print(f"{name}: {entered}")
    for coat in aging:
        console.print(f"{coat.title} {coat.text}")
    live = [job for job in state.step.jobs.values() if job.kind == LIVE_VIEW.name and job.status != "enqueued"]
    for job in live[-3:]:
        console.print(describe_view(job))
    for one in computing:
        console.print(f"{one.text}: `orthocapture cancel {one.job}` ends it")
    for line in missing:
        console.print(f"result to come: {line}")
    for way in ways_on(protocol, state):
        can = f"takes {takes_words(way.minutes)}, loses: {way.loses}" if way.available else f"no: {way.why_not}"
        console.print(f"way on: {way.verb} {way.step}: {way.words}; {can}")
    lines = [f"deviation: {deviation.text}" for deviation in state.deviations]
    for line in lines if uploading is None else [*lines, f"object store: {uploading.sentence}"]:
        console.print(line)


def _uploading(store: Store) -> SpoolLevel | None:
    """Return what waits for the site's object store; None without a site.yaml, which nothing else is read for."""
    if not (store.database_path.parent / SITE_FILE).is_file():
        return None
    from service.store.objects.spool import spool_level  # noqa: PLC0415 - for sites only

    return spool_level(store)


_STANDINGS: dict[Standing, str] = {
    "within": "ok",
    "not_decided": "NOT DECIDED",
    "accepted": "ACCEPTED",
    "outside": "FAILED",
}


def _standing(verdict: GateVerdict, step: StepState) -> Standing:
    return standing(verdict, accepted=step.accepted is not None)


def status_record(run_id: str, state: RunState) -> dict[str, Any]:
    """Return a run's state as plain data, for JSON output."""
    return {
        "run": run_id,
        "status": state.status,
        "current": state.current,
        "deviations": [d.text for d in state.deviations],
        "counts_as_moving": {
            arm: {"since_utc": loss.since_utc, "how": loss.how} for arm, loss in lost_arms(state).items()
        },
        "steps": {
            name: {
                "phase": s.phase,
                "attempt": s.attempt,
                "captured": sorted(s.captured),
                "measures": dict(s.measures),
                "gates": [v.model_dump() | {"standing": _standing(v, s), "text": describe(v)} for v in s.verdicts],
                "live": [
                    {"viewpoint": LIVE_VIEW.read_answer(job.result).viewpoint, **job.measures}
                    for job in s.jobs.values()
                    if job.kind == LIVE_VIEW.name and job.status == "finished"
                ],
            }
            for name, s in state.steps.items()
        },
        "next_best_views": [view.plain() for view in next_best_views(state)],
    }


def next_best_views(state: RunState) -> tuple[Suggestion, ...]:
    """Return the suggested views in a run's newest summary of its images; empty before the first one."""
    jobs = [job for step in state.steps.values() for job in step.jobs.values()]
    done = [job for job in jobs if job.kind == LIVE_SUMMARY.name and job.status == "finished"]
    newest = max(done, key=lambda job: job.enqueued_seq, default=None)
    return () if newest is None else LIVE_SUMMARY.read_answer(newest.result).next_best_views


# --- `runs`, `compare` and `history` ------------------------------------------------------------------------------


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
