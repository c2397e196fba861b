"""The rows of runs: begun, listed, found by name, and those that have not ended."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, case, func, insert, select

from service.core.records.events import RunStarted, SiteOpened
from service.store.database.tables import event_index, events, heads, runs
from service.store.durable_effects import Clock
from service.store.errors import UnknownRunError
from service.store.events import ROOT, append
from service.store.files.artefacts import ArtefactFiles, insert_artefacts
from service.store.records import SITE, NewArtefact, RunRow

_ENDS = ("run_completed", "run_aborted")


def begin_chain(
    connection: Connection,
    clock: Clock,
    folder: ArtefactFiles,
    run_id: str,
    payload: RunStarted | SiteOpened,
    actor: str,
    artefacts: Sequence[NewArtefact],
) -> None:
    """Insert the row of a run, or of the site, with the first event of its chain and the artefacts of that event."""
    # The run's row holds the hash of the root event, which refers to the row; keys are checked at commit.
    connection.exec_driver_sql("PRAGMA defer_foreign_keys = ON")
    connection.execute(insert(heads).values(run_id=run_id, seq=0, sha256=ROOT))
    (root,) = append(connection, clock, run_id, [payload], actor)
    simulated = isinstance(payload, RunStarted) and payload.simulated
    connection.execute(
        insert(runs).values(
            run_id=run_id,
            created_utc=root.at_utc,
            simulated=int(simulated),
            root_sha256=root.sha256,
        )
    )
    insert_artefacts(connection, folder, [root], artefacts)


def read_runs(connection: Connection) -> list[RunRow]:
    """All runs, oldest first, without the site's chain."""
    statement = (
        select(runs, heads.c.seq, heads.c.sha256)
        .outerjoin(heads, heads.c.run_id == runs.c.run_id)
        .where(runs.c.run_id != SITE)
        .order_by(runs.c.created_utc, runs.c.run_id)
    )
    return [
        RunRow(row.run_id, row.created_utc, bool(row.simulated), row.root_sha256, row.seq or 0, row.sha256 or ROOT)
        for row in connection.execute(statement)
    ]


def read_open_runs(connection: Connection) -> set[str]:
    """Runs that have neither an end recorded by the runner nor an operator's abort, which it confirms later."""
    ended = (
        select(event_index.c.seq)
        .where(event_index.c.run_id == heads.c.run_id, event_index.c.kind.in_(_ENDS))
        .exists()
    )
    aborted = (
        select(events.c.seq)
        .where(
            events.c.run_id == heads.c.run_id,
            events.c.seq == event_index.c.seq,
            event_index.c.run_id == heads.c.run_id,
            event_index.c.kind == "operator_action",
            # A damaged payload must not raise here; the verification finds it.
            case((func.json_valid(events.c.payload) == 1, func.json_extract(events.c.payload, "$.action")))
            == "abort",
        )
        .correlate(heads)
        .exists()
    )
    found = select(heads.c.run_id).where(heads.c.run_id != SITE, ~ended, ~aborted)
    return set(connection.execute(found).scalars())


def resolve_run(known: Sequence[RunRow], name: str) -> str:
    """The run for a full name, an unambiguous beginning, or `latest`. Raises UnknownRunError."""
    if not known:
        raise UnknownRunError("there is no run in this data folder yet", remedy="Start one with `orthocapture run`")
    if name == "latest":
        return known[-1].run_id
    matches = [run.run_id for run in known if run.run_id == name] or [
        run.run_id for run in known if name and run.run_id.startswith(name)
    ]
    if len(matches) != 1:
        newest = ", ".join(run.run_id for run in known[-3:])
        what = f"no run is called {name!r}" if not matches else f"{name!r} is the beginning of {len(matches)} runs"
        raise UnknownRunError(what, remedy=f"The newest are: {newest}; or say `latest`")
    return matches[0]
