"""Health of a data folder, in words: database, disk, workers and runners."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import text

from service.core.equipment.disk_space import LEAST_FREE_BYTES
from service.core.errors import OrthocaptureError
from service.core.units import gigabytes
from service.monitor.snapshot import read_snapshot
from service.monitor.worker_sign import living_workers
from service.store.durable_effects import Clock
from service.store.signatures.second_place import Away
from service.store.store import Store

_SILENT_S = 60.0  # a runner's longest call, fetching one photograph, is shorter


@dataclass(frozen=True, slots=True)
class Health:
    """What is wrong with each part; "" if nothing is."""

    database: str
    data_folder: str
    worker: str
    runners: str
    second_place: str

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
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
