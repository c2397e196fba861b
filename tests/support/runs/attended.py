"""Runs that look driven: this process holds their leases and writes the snapshots that a runner would write."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.monitor.snapshot import Snapshot, write_snapshot
from service.store.store import Store

_LEASE_S = 600.0


@contextmanager
def attended(data: Path, runs: Mapping[str, Mapping[str, Any]]) -> Generator[None]:
    """Attend these runs, with the given fields in their snapshots; nothing moves and nothing is recorded."""
    over = threading.Event()

    def tell() -> None:
        now_utc_s = store.clock.utc_s()
        for run_id, fields in runs.items():
            write_snapshot(data, run_id, Snapshot.model_validate({"at_utc_s": now_utc_s, **fields}))

    def go_on_telling() -> None:
        while not over.wait(1.0):
            tell()

    with Store.open(data) as store, contextlib.ExitStack() as leases:
        for run_id in runs:
            leases.enter_context(store.lease(run_id, "attended", _LEASE_S))
        tell()
        teller = threading.Thread(target=go_on_telling)
        teller.start()
        try:
            yield
        finally:
            over.set()
            teller.join()
            for run_id in runs:  # code that ends runners reads their pids there
                (data / "monitor" / f"{run_id}.json").unlink(missing_ok=True)
