"""Reads the operating figures of a data folder and its health from the record and from what processes report."""

from __future__ import annotations

import os
import shutil
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

from pydantic import BaseModel
from sqlalchemy import Connection, case, func, select, text

from service.core.disk_space import LEAST_FREE_BYTES
from service.core.errors import OrthocaptureError
from service.core.records.run_events import RunStarted
from service.core.run.expected import EarlierTimes
from service.core.run.state import EARLY
from service.core.units import gigabytes
from service.monitor.snapshot import Doing, RobotPhase, living_workers, read_snapshot
from service.store.database.database import seconds_between
from service.store.database.tables import event_index, events, jobs, runs
from service.store.durable_effects import Clock
from service.store.events import parse_canonical
from service.store.records import SITE
from service.store.runs import read_open_runs
from service.store.signatures.second_place import Away
from service.store.store import Store

CAPTURED = ("viewpoint_captured", "view_held", "view_imported")
_LAST_CAPTURES = 21  # used for the median time per viewpoint


@dataclass(frozen=True, slots=True)
class DeviceFigures:
    """The state of a device as a run last recorded it."""

    run_id: str
    device: str  # name in rig.yaml
    kind: str  # robot, camera, …
    answers: bool  # it was opened, and no fault was recorded since
    problems: int  # named in its report


@dataclass(frozen=True, slots=True)
class DrivenRun:
    """A run that a process drives now."""

    run_id: str
    doing: Doing
    robot: RobotPhase
    silent_s: float  # seconds since its runner last reported; inf: never
    viewpoint_s: float | None  # median time between the last exposures of one step; None: too few yet


@dataclass(frozen=True, slots=True)
class Figures:
    """All figures at one moment."""

    runs: Mapping[str, int]  # completed, aborted, open
    driven: Sequence[DrivenRun]
    shown: Sequence[str]  # runs whose devices are listed: the driven ones, else the newest
    captures: int  # photographs recorded in all runs
    jobs: Mapping[tuple[str, str], int]  # kind and state
    job_seconds: Mapping[str, tuple[int, float]]  # kind → number of finished jobs, and their total time
    queue: Mapping[str, int]  # open jobs that no worker has claimed: waited (a step waits for them), background
    devices: Sequence[DeviceFigures]
    workers: int
    database_bytes: int
    free_bytes: int


def read_figures(store: Store, data: Path, driven: Sequence[str]) -> Figures:
    """Read all figures; `driven` are the runs driven now. Raises StoreError; OSError if the disk fails."""
    now_utc_s = store.clock.utc_s()
    with store.database.reading() as connection:
        latest = select(runs.c.run_id).where(runs.c.run_id != SITE).order_by(runs.c.created_utc.desc()).limit(1)
        shown = list(driven) or list(connection.execute(latest).scalars())
        return Figures(
            runs=_runs(connection),
            driven=[_driven(connection, data, run_id, now_utc_s) for run_id in driven],
            shown=shown,
            captures=connection.execute(
                select(func.count()).select_from(event_index).where(event_index.c.kind.in_(CAPTURED))
            ).scalar_one(),
            jobs={
                (row.kind, row.state): row.n
                for row in connection.execute(
                    select(jobs.c.kind, jobs.c.state, func.count().label("n")).group_by(jobs.c.kind, jobs.c.state)
                )
            },
            job_seconds=_job_seconds(connection),
            queue=_queue(connection),
            devices=[device for run_id in shown for device in _devices(connection, run_id)],
            workers=len(living_workers(data, store.clock)),
            database_bytes=_database_bytes(store.database_path),
            free_bytes=shutil.disk_usage(data).free,
        )


def _runs(connection: Connection) -> dict[str, int]:
    known = connection.execute(select(func.count()).select_from(runs).where(runs.c.run_id != SITE)).scalar_one()
    ended = select(func.count(event_index.c.run_id.distinct())).where(event_index.c.kind == "run_completed")
    completed = connection.execute(ended).scalar_one()
    still = len(read_open_runs(connection))
    return {"completed": completed, "aborted": known - completed - still, "open": still}


def _driven(connection: Connection, data: Path, run_id: str, now_utc_s: float) -> DrivenRun:
    snapshot = read_snapshot(data, run_id, now_utc_s)
    silent_s = snapshot.unattended_s(now_utc_s) if snapshot.at_utc_s else float("inf")
    return DrivenRun(run_id, snapshot.doing, snapshot.robot, max(0.0, silent_s), _viewpoint_s(connection, run_id))


def _viewpoint_s(connection: Connection, run_id: str) -> float | None:
    of_event = (events.c.run_id == event_index.c.run_id) & (events.c.seq == event_index.c.seq)
    last = (
        select(event_index.c.step, events.c.monotonic_s)
        .join(events, of_event)
        .where(event_index.c.run_id == run_id, event_index.c.kind.in_(CAPTURED))
        .order_by(event_index.c.seq.desc())
        .limit(_LAST_CAPTURES)
    )
    rows = connection.execute(last).all()
    of_step = [new.monotonic_s - old.monotonic_s for new, old in pairwise(rows) if new.step == old.step]
    between = [seconds for seconds in of_step if seconds > 0]  # after a reboot the clock begins anew
    return statistics.median(between) if between else None


def _job_seconds(connection: Connection) -> dict[str, tuple[int, float]]:
    taken_s = seconds_between(connection, jobs.c.started_utc, jobs.c.ended_utc)
    found = (
        select(jobs.c.kind, func.count().label("n"), func.sum(taken_s).label("seconds"))
        .where(jobs.c.state == "finished", jobs.c.started_utc.is_not(None))
        .group_by(jobs.c.kind)
    )
    return {row.kind: (row.n, max(0.0, float(row.seconds))) for row in connection.execute(found)}


def _queue(connection: Connection) -> dict[str, int]:
    lane = case((jobs.c.priority < EARLY, "waited"), else_="background")
    found = select(lane.label("lane"), func.count().label("n")).where(jobs.c.state == "queued").group_by(lane)
    return {"waited": 0, "background": 0} | {row.lane: row.n for row in connection.execute(found)}


class _Identity(BaseModel):
    kind: str = ""


class _Report(BaseModel):
    identity: _Identity = _Identity()
    problems: tuple[str, ...] = ()


class _DeviceEvent(BaseModel):
    """The part of the events device_opened and device_trouble that the figures need; of any version."""

    kind: str
    device: str
    report: _Report = _Report()


def _devices(connection: Connection, run_id: str) -> list[DeviceFigures]:
    of_event = (events.c.run_id == event_index.c.run_id) & (events.c.seq == event_index.c.seq)
    found = (
        select(events.c.payload)
        .join(event_index, of_event)
        .where(event_index.c.run_id == run_id, event_index.c.kind.in_(("device_opened", "device_trouble")))
        .order_by(event_index.c.seq)
    )
    devices: dict[str, DeviceFigures] = {}
    for payload in connection.execute(found).scalars():
        event = _DeviceEvent.model_validate(parse_canonical(payload))
        known = devices.get(event.device)
        if event.kind == "device_opened":
            report = event.report
            devices[event.device] = DeviceFigures(
                run_id, event.device, report.identity.kind, True, len(report.problems)
            )
        elif known is not None:  # faults of anything that is not a device of the rig file name a step
            devices[event.device] = DeviceFigures(run_id, event.device, known.kind, False, known.problems)
    return list(devices.values())


def _database_bytes(path: Path) -> int:
    """Return the size including the write-ahead log."""
    parts = (path, path.with_name(path.name + "-wal"))
    return sum(part.stat().st_size for part in parts if part.exists())


_SILENT_S = 60.0  # a runner's longest call, fetching one photograph, is shorter


@dataclass(frozen=True, slots=True)
class Health:
    """The problem of each part; "" if it has none."""

    database: str
    data_folder: str
    worker: str
    runners: str
    second_place: str

    @property
    def ok(self) -> bool:
        """True if no part has a problem."""
        return not (self.database or self.data_folder or self.worker or self.runners or self.second_place)


def read_health(store: Store, data: Path, driven: Sequence[str], away: Away | None = None) -> Health:
    """Check every part. The words name no runs, people or paths, because anyone may ask.

    `away` is what is known of the second place of the signatures.
    """
    try:
        with store.database.reading() as connection:
            connection.execute(text("SELECT 1 FROM heads LIMIT 1")).all()
        store.database.require_record()
        database, queued = "", store.open_jobs()
    except OrthocaptureError as error:
        database, queued = error.what, 0
    return Health(
        database,
        _data_folder(data),
        _worker(data, queued, store.clock),
        _runners(data, driven, store.clock.utc_s()),
        "" if away is None else f"it has not been up to date since {away.since_utc}",
    )


def _data_folder(data: Path) -> str:
    try:
        free = shutil.disk_usage(data).free
    except OSError as error:
        return f"it cannot be reached: {error.strerror}"
    if not os.access(data / "artefacts", os.W_OK):
        return "it cannot be written to"
    if free >= LEAST_FREE_BYTES:
        return ""
    kept = f"the last {gigabytes(LEAST_FREE_BYTES):.2f} GB are kept for what is under way"
    return f"{gigabytes(free):.2f} GB are free: too little to capture; {kept}"


def _worker(data: Path, queued: int, clock: Clock) -> str:
    if not queued or living_workers(data, clock):
        return ""
    waiting = "a job waits" if queued == 1 else f"{queued} jobs wait"
    return f"{waiting}, and no worker is running"


def _runners(data: Path, driven: Sequence[str], now_utc_s: float) -> str:
    snapshots = [read_snapshot(data, run_id, now_utc_s) for run_id in driven]
    silent = [shot for shot in snapshots if shot.at_utc_s and shot.unattended_s(now_utc_s) > _SILENT_S]
    return f"{len(silent)} of {len(driven)} runners have not reported for {_SILENT_S:.0f} s" if silent else ""


_RUNS = 10  # earlier runs that are looked at, the latest ones
_BEGINS, _ENDS = ("step_started", "step_retried"), "step_measured"
# A person paused the work or had a part of it done again: such an attempt does not tell how long it takes.
_INTERRUPTS = ("operator_action", "leave_lapsed")


def read_step_times(store: Store, run_id: str) -> EarlierTimes:
    """Return the seconds from the start of each step's work to its figures, in earlier runs of the run's protocol.

    Runs of a simulated rig say nothing of a real one, nor the other way round. Raises StoreError.
    """
    mine = store.first_event(run_id).payload
    assert isinstance(mine, RunStarted)  # checked when the run was read
    names = [row.run_id for row in store.runs() if row.simulated == mine.simulated]
    before = names[: names.index(run_id)] if run_id in names else names
    earlier: list[str] = []
    for name in reversed(before):
        root = store.first_event(name).payload
        if isinstance(root, RunStarted) and (root.protocol_id, root.origin) == (mine.protocol_id, mine.origin):
            earlier.append(name)
        if len(earlier) == _RUNS:
            break
    times: dict[str, list[float]] = {}
    began: dict[str, datetime] = {}
    of_event = (events.c.run_id == event_index.c.run_id) & (events.c.seq == event_index.c.seq)
    found = (
        select(event_index.c.run_id, event_index.c.kind, event_index.c.step, events.c.at_utc)
        .join(events, of_event)
        .where(event_index.c.run_id.in_(earlier), event_index.c.kind.in_((*_BEGINS, _ENDS, *_INTERRUPTS)))
        .order_by(event_index.c.position)
    )
    with store.database.reading() as connection:
        for row in connection.execute(found):
            at = datetime.fromisoformat(row.at_utc)
            if row.kind in _BEGINS:
                began[row.run_id] = at
            elif (since := began.pop(row.run_id, None)) is not None and row.kind == _ENDS and at >= since:
                times.setdefault(row.step, []).append((at - since).total_seconds())
    return times
