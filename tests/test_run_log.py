"""A run's log that many requests read at once."""

from __future__ import annotations

import threading
from pathlib import Path

from service.core.model import StepNote
from service.evidence import RunLog
from service.runs import recorded_run
from service.store.store import Store
from tests.support.bench_run import PROTOCOL, begin_run


def test_a_log_that_many_threads_bring_up_to_date_takes_every_event_once(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store:
        run_id = begin_run(store, PROTOCOL, tmp_path).run_id
        protocol, _ = recorded_run(store, run_id)
        log = RunLog(store, run_id, protocol)
        problems: list[BaseException] = []
        together = threading.Barrier(6)

        def read() -> None:
            together.wait()
            try:
                for _ in range(40):
                    log.refresh()
            except Exception as error:  # noqa: BLE001 - told to the test
                problems.append(error)

        readers = [threading.Thread(target=read) for _ in range(6)]
        for reader in readers:
            reader.start()
        for number in range(60):
            note = StepNote(step="fixation", attempt=1, note=f"note {number}")
            store.record(run_id, [note], actor="runner")
        for reader in readers:
            reader.join()
        log.refresh()
        assert problems == []
        assert [event.seq for event in log.events] == list(range(1, store.head(run_id) + 1))
