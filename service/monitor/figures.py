"""The operating figures of a data folder, read from the record and from what processes report."""

from __future__ import annotations

import shutil
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pydantic import BaseModel
from sqlalchemy import Connection, case, func, select

from service.core.jobs.priorities import EARLY
from service.monitor.snapshot import Doing, RobotPhase, read_snapshot
from service.monitor.worker_sign import living_workers
from service.store.database.tables import event_index, events, jobs, runs
from service.store.events import parse_canonical
from service.store.records import SITE
from service.store.run_rows import read_open_runs
from service.store.store import Store

CAPTURED = ("viewpoint_captured", "view_held", "view_imported")
_LAST_CAPTURES = 21  # used for the median time per viewpoint


@dataclass(frozen=True, slots=True)
class DeviceFigures:
    """What a run last recorded about a device."""

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
    silent_s: float  # since its runner last reported; inf: never
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
    taken_s = (func.julianday(jobs.c.ended_utc) - func.julianday(jobs.c.started_utc)) * 86400
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
    for text in connection.execute(found).scalars():
        event = _DeviceEvent.model_validate(parse_canonical(text))
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
    """Size including the write-ahead log."""
    parts = (path, path.with_name(path.name + "-wal"))
    return sum(part.stat().st_size for part in parts if part.exists())
