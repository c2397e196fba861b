"""What the journal costs a write: `python -m bench.journal.cost`; with and without it, in turn, on one disk.

A write is one event of a run, or one photograph with its row. "Without" is the same program whose journal is switched
off. The time that a disk takes to sync a file is measured beside it, since it is most of a write.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from bench.machine import RESULTS, commit, machine
from service.core.records.run_events import OperatorAction
from service.store.database.engine import SqliteDatabase
from service.store.durable_effects import DurableFiles
from service.store.store import Store
from tests.support.record.store import capture, start_run

_KEYS = ("p10_ms", "median_ms", "p95_ms", "processor_ms")
_ROUND = 20  # writes of one kind before the other kind's turn, so that both meet the same load of the machine


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--writes", type=int, default=600)
    parser.add_argument(
        "--folder", type=Path, default=None, help="on the disk to measure; default: the temporary folder"
    )
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(words)
    with tempfile.TemporaryDirectory(dir=options.folder) as work:
        disk = _measured(Path(work), options.writes)
    with tempfile.TemporaryDirectory(dir="/dev/shm") as work:
        memory = _measured(Path(work), options.writes)
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "writes_of_each_kind": options.writes,
        "disk": disk,
        "memory": memory,
    }
    text = _report(about)
    sys.stdout.write(text)
    stem = options.results / f"journal_cost-{about['date']}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return 0


def _measured(work: Path, writes: int) -> dict[str, dict[str, float]]:
    """Milliseconds by kind: 10th percentile, median and 95th of the wall clock, mean of the processor."""
    with Store.open(work / "with") as with_journal:
        with patch.object(SqliteDatabase, "_watched", lambda *_: None):
            without = Store.open(work / "without")
            runs = {id(without): start_run(without)}
        runs[id(with_journal)] = start_run(with_journal)
        wall: dict[str, list[float]] = {}
        processor: dict[str, list[float]] = {}

        def take(name: str, act: Callable[[], object]) -> None:
            begun_s, used_s = time.perf_counter(), time.process_time()
            act()
            wall.setdefault(name, []).append(1e3 * (time.perf_counter() - begun_s))
            processor.setdefault(name, []).append(1e3 * (time.process_time() - used_s))

        for first in range(0, writes, _ROUND):
            for name, store in (("with", with_journal), ("without", without)):
                run_id = runs[id(store)]
                with patch.object(SqliteDatabase, "_watched", lambda *_: None) if name == "without" else _as_it_is():
                    for number in range(first, first + _ROUND):
                        event = OperatorAction(action="pause", reason=f"lunch {number}")
                        take(f"event, {name}", partial(store.record, run_id, [event], actor="Ada"))
                        take(f"photograph, {name}", partial(capture, store, run_id, f"v{number}"))
            _sync(work / "synced", take)
        without.close()
    return {name: _figures(times, processor[name]) for name, times in wall.items()}


def _as_it_is() -> Any:
    return patch.object(SqliteDatabase, "_watched", SqliteDatabase.__dict__["_watched"])


def _sync(path: Path, take: Callable[[str, Callable[[], object]], None]) -> None:
    files = DurableFiles()
    if not path.exists():
        files.write(path, ())
    for _ in range(_ROUND):
        files.append(path, path.stat().st_size, bytes(1000))
        take("a file of 1000 bytes more, synced", lambda: files.sync_file(path))


def _figures(times: list[float], processor: list[float]) -> dict[str, float]:
    ordered = sorted(times)
    return {
        "p10_ms": round(ordered[int(0.1 * len(ordered))], 3),
        "median_ms": round(statistics.median(ordered), 3),
        "p95_ms": round(ordered[int(0.95 * len(ordered))], 3),
        "processor_ms": round(statistics.mean(processor), 3),
    }


def _report(about: dict[str, Any]) -> str:
    cpu = about["machine"]
    on = f"{cpu['processor']}, {cpu['cores']} cores, Python {cpu['python']}, load {about['load']}"
    lines = [
        f"# What the journal costs a write ({about['date']})",
        "",
        f"`python -m bench.journal.cost`; commit {about['commit']}; {on};",
        f"{about['writes_of_each_kind']} writes of each kind, with and without the journal in turn.",
        "",
        "| where | write | 10th percentile ms | median ms | 95th percentile ms | processor ms |",
        "|---|---|---|---|---|---|",
    ]
    for place in ("disk", "memory"):
        figures: dict[str, dict[str, float]] = about[place]
        for name, found in sorted(figures.items()):
            lines.append(f"| {place} | {name} | {' | '.join(str(found[key]) for key in _KEYS)} |")
        for kind in ("event", "photograph"):
            one, other = figures[f"{kind}, with"], figures[f"{kind}, without"]
            more = " | ".join(f"{one[key] - other[key]:.3f}" for key in _KEYS)
            lines.append(f"| {place} | **{kind}: the journal's share** | {more} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
