"""`orthocapture status`: the state of a run, as a table or as plain data."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.table import Table

from service.cli.common import (
    DEFAULT_DATA,
    DataOption,
    JsonOption,
    RunArgument,
    console,
    print_json,
    print_table,
    reporting_errors,
)
from service.cli.terminal_output import listed
from service.computations.live import LIVE_SUMMARY, LIVE_VIEW, Suggestion
from service.core.gates import Standing, describe, standing
from service.core.records.entered import about_rows
from service.core.records.run_events import GateVerdict
from service.core.recovery import takes_words, ways_on
from service.core.run.expected import tries_words
from service.core.run.state import RunState, StepState, lost_arms
from service.core.words import time_utc
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
