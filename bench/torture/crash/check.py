"""Checks a folder right after a crash, and the run that was resumed and completed afterwards."""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.torture.crash.confirmed import confirmed
from bench.torture.crash.run import Place, Role
from bench.torture.crash.scene import import_list, planned
from service.core.protocol import Protocol
from service.core.records.events import Event
from service.core.records.run_events import JobFinished, RecordedView, StepMeasured
from service.followed_run import read_log
from service.run_start import recorded_run
from service.store.database.engine import database_path
from service.store.disk_space import leftovers, remove_leftovers
from service.store.records import StoreVersionError
from service.store.signatures.log import NAME as LOG_NAME
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.mortal_files import read_journal

ROLES: tuple[Role, ...] = ("begin", "runner", "worker", "web")


@dataclass(frozen=True, slots=True)
class Outcome:
    """The results of a run that must not depend on where it was killed.

    Attributes:
        results: of the computing steps, as canonical text: positions, covariance, residuals, errors.
        jobs: number of finished jobs of each kind.
    """

    results: str
    jobs: dict[str, int]


def outcome(events: Sequence[Event]) -> Outcome:
    """Extract the outcome from a run's events."""
    results: dict[str, Any] = {}
    jobs: Counter[str] = Counter()
    for event in events:
        payload = event.payload
        if isinstance(payload, StepMeasured) and payload.step in ("scan", "registration", "evaluation"):
            timeless = {k: v for k, v in payload.measures.items() if k != "since_application_min"}
            results[payload.step] = {"result": payload.result, "measures": timeless}
        if isinstance(payload, JobFinished):
            jobs[payload.job_kind] += 1
    return Outcome(json.dumps(results, sort_keys=True), dict(jobs))


def after_the_crash(place: Place) -> list[str]:
    """Faults of a folder before anybody has resumed the run: nothing reported as recorded may be missing."""
    if not database_path(place.data).exists() and not _events_said(place):
        return []  # nobody was told that anything was recorded
    try:
        found = [f"after the crash: {fault}" for fault in verify(place.data).faults]
    except StoreVersionError:  # its tables do not exist yet
        return ["after the crash: the tables are gone"] if _events_said(place) else []
    said = _events_said(place)
    with closing(sqlite3.connect(f"file:{database_path(place.data)}?mode=ro", uri=True)) as connection:
        there = int(connection.execute("SELECT coalesce(sum(seq), 0) FROM heads").fetchone()[0])
    if there < said:
        found.append(f"after the crash: {there} events of {said} that were recorded")
    return found


def of_a_beginning(place: Place) -> tuple[list[str], int]:
    """Faults of a folder in which a run was begun, perhaps twice; and the number of leftovers collected."""
    with Store.open(place.data) as store:
        begun = len(store.runs())
        gone = remove_leftovers(store, actor="Sue", min_age_s=0)
    report = verify(place.data)
    found = [str(fault) for fault in report.faults]
    found += [f"after store gc: {note}" for note in report.notes if note.startswith("artefacts/")]
    if begun not in (1, 2):
        found.append(f"{begun} runs were begun")
    return found, len(gone)


def _events_said(place: Place) -> int:
    """The number of events recorded by commits that returned."""
    return max(
        (line["events"] for role in ROLES for line in read_journal(place.journal(role)) if "events" in line),
        default=0,
    )


def at_the_end(place: Place, expected: Outcome | None) -> tuple[list[str], int]:
    """Faults of a completed run, and the number of leftovers collected. `expected` is that of the undisturbed run."""
    found: list[str] = []
    with Store.open(place.data) as store:
        run_id = store.find_run("latest")
        protocol, _ = recorded_run(store, run_id)
        log = read_log(store, run_id, protocol)
        if (log.state.status, log.state.released_by) != ("completed", "Sue"):
            found.append(f"the run is {log.state.status}, released by {log.state.released_by or 'nobody'}")
        found += _once(log.events, [v.name for v in planned()] + [v.name for v in import_list(place.files).views])
        if expected is not None:
            mine = outcome(log.events)
            if mine.results != expected.results:
                found.append("the results are not those of the undisturbed run")
            if mine.jobs != expected.jobs:
                found.append(f"jobs were finished {mine.jobs} times, undisturbed {expected.jobs}")
        found += _surprises(place.motions, log.events, protocol)
        report = verify(place.data, signatures_copy=place.signature_copy)
        found += [str(fault) for fault in report.faults]
        found += [f"{count} events of {run} are not signed" for run, count in report.unsigned_events.items() if count]
        noted = sorted(note.split(":")[0] for note in report.notes if note.startswith("artefacts/"))
        left = leftovers(store, min_age_s=0)
        if [one.path for one in left] != noted:
            found.append(f"store gc finds {[one.path for one in left]}, audit verify {noted}")
        gone = remove_leftovers(store, actor="Sue", min_age_s=0)
        if len(gone) != len(left):
            found.append(f"store gc left {leftovers(store, min_age_s=0)}")
    if gone:
        after = verify(place.data)
        found += [f"after store gc: {fault}" for fault in after.faults]
        found += [f"after store gc: {note}" for note in after.notes if note.startswith("artefacts/")]
    if place.signature_copy.read_bytes() != (place.data / LOG_NAME).read_bytes():
        found.append("the copy of the log of signatures is not the log")
    if list((place.data / "keys").glob("*.part")):
        found.append("half a key is left")
    return found, len(gone)


def _once(events: Sequence[Event], names: Sequence[str]) -> list[str]:
    """Faults if a viewpoint or photograph is missing or duplicated."""
    taken = Counter(event.payload.viewpoint for event in events if isinstance(event.payload, RecordedView))
    wrong = {name: taken[name] for name in {*names, *taken} if taken[name] != (name in names)}
    return [f"{name} is in the record {count} times" for name, count in sorted(wrong.items())]


def _surprises(motions: Path, events: Sequence[Event], protocol: Protocol) -> list[str]:
    """Motions without a person's confirmation since the start of the program that made them."""
    if not motions.exists():
        return ["the arm never moved"]
    moments = map(float, motions.read_text().splitlines())
    return [
        f"the arm moved at {moment:.3f} s without a confirmation"
        for moment in moments
        if not confirmed(events, protocol, moment)
    ]
