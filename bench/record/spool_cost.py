"""What an object store costs a capture: `python -m bench.record.spool_cost`; with it, without it, and with it away.

A capture is one photograph with its row and event. Three data folders take them in turn, one capture each: one
without a site.yaml, one whose uploader uploads meanwhile to a SeaweedFS on this machine, and one whose uploader finds
no server. So all three meet the same load, uploads and server included; what differs is what a capture itself does
for the store. That is also counted, which no load can blur: writes, syncs, commits and system calls.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from bench.machine import RESULTS, commit, machine
from service.store.durable_effects import DurableFiles
from service.store.records import NewArtefact
from service.store.store import Store
from tests.support.processes.object_store import Weed
from tests.support.record.store import captured, start_run

ABSENT, PRESENT, AWAY = "no object store", "object store present", "object store away"
_READS = (
    "Pages of the database are read again after another process has written, as an uploader does once it has rows of "
    "`copies`,\nand as any worker does: hence the read calls. Everything that a capture writes is the same."
)
_FIGURES = ("median_ms", "p95_ms", "ratio_of_medians", "median_of_paired_ratios")
KINDS = (ABSENT, PRESENT, AWAY)
_UPLOADER = [sys.executable, "-m", "service.cli.main", "store", "upload", "--follow"]


@dataclass(frozen=True, slots=True)
class Measured:
    """The durations of each capture in ms, and what all of them did, both by kind of data folder."""

    times_ms: dict[str, list[float]]
    done: dict[str, dict[str, int]]


class CountedFiles(DurableFiles):
    """Counts the durable effects of a store: writes, renames, syncs and commits."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Count, then do it."""
        self.calls["files written"] += 1
        super().write(path, chunks, private=private)

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """Count, then do it."""
        self.calls["appends"] += 1
        super().append(path, offset, data)

    def sync_file(self, path: Path) -> None:
        """Count, then do it."""
        self.calls["files synced"] += 1
        super().sync_file(path)

    def sync_directory(self, path: Path) -> None:
        """Count, then do it."""
        self.calls["folders synced"] += 1
        super().sync_directory(path)

    def rename(self, source: Path, target: Path) -> None:
        """Count, then do it."""
        self.calls["renames"] += 1
        super().rename(source, target)

    def commit(self, commit: Callable[[], None]) -> None:
        """Count, then do it."""
        self.calls["commits"] += 1
        super().commit(commit)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=90)
    parser.add_argument("--megabytes", type=float, default=8.0, help="size of a photograph")
    parser.add_argument("--pause-s", type=float, default=0.4, help="between two captures")
    parser.add_argument("--folder", type=Path, default=None, help="on the disk to measure")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as work, ExitStack() as stack:
        measured = _measure(Path(work), stack, options.rounds, int(1e6 * options.megabytes), options.pause_s)
    times = measured.times_ms
    pairs = {name: [one / other for one, other in zip(times[name], times[ABSENT], strict=True)] for name in times}
    medians = {name: statistics.median(found) for name, found in times.items()}
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "captures_of_each_kind": options.rounds,
        "photograph_megabytes": options.megabytes,
        "pause_s": options.pause_s,
        "median_ms": {name: round(found, 3) for name, found in medians.items()},
        "p95_ms": {name: round(sorted(found)[int(0.95 * len(found))], 3) for name, found in times.items()},
        "ratio_of_medians": {name: round(found / medians[ABSENT], 4) for name, found in medians.items()},
        "median_of_paired_ratios": {name: round(statistics.median(found), 4) for name, found in pairs.items()},
        "done": measured.done,
    }
    text = _report(about)
    sys.stdout.write(text)
    stem = options.results / f"spool_cost-{about['date']}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return 0


def _measure(work: Path, stack: ExitStack, rounds: int, size_bytes: int, pause_s: float) -> Measured:
    """Capture into the three folders in turn, one photograph each, in an order that rotates."""
    server = Weed(work / "server")
    gone = Weed(work / "gone")  # never started: nobody listens there
    server.start()
    stack.callback(server.kill)
    server.write_site(work / PRESENT)
    gone.write_site(work / AWAY)
    files = {name: CountedFiles() for name in KINDS}
    stores = {name: stack.enter_context(Store.open(work / name, files=files[name])) for name in KINDS}
    runs = {name: start_run(store) for name, store in stores.items()}
    for name in (PRESENT, AWAY):
        process = subprocess.Popen([*_UPLOADER, "--data", str(work / name)])
        stack.callback(process.wait)
        stack.callback(process.terminate)
    random = np.random.default_rng(0)
    times: dict[str, list[float]] = {name: [] for name in KINDS}
    done: dict[str, Counter[str]] = {name: Counter() for name in KINDS}
    for number in range(rounds):
        photograph = random.bytes(size_bytes)
        for name in [*KINDS[number % 3 :], *KINDS[: number % 3]]:
            files[name].calls.clear()
            before, begun_s = _system_calls(), time.perf_counter()
            _capture(stores[name], runs[name], f"v{number}", photograph)
            times[name].append(1e3 * (time.perf_counter() - begun_s))
            after = _system_calls()
            done[name].update(files[name].calls)
            done[name].update({call: after[call] - before[call] for call in after})
            time.sleep(pause_s)
    return Measured(times, {name: dict(sorted(counter.items())) for name, counter in done.items()})


def _system_calls() -> dict[str, int]:
    """Return how many system calls of this process have read and written until now."""
    found = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return {"read calls": int(found["syscr"]), "write calls": int(found["syscw"])}


def _capture(store: Store, run_id: str, viewpoint: str, photograph: bytes) -> None:
    ref = store.put_bytes(photograph, kind="image", media_type="image/jpeg", original_name=f"{viewpoint}.jpg")
    payload = captured(ref, viewpoint)
    store.record(run_id, [payload], actor="runner", artefacts=[NewArtefact(ref, "camera", "capture", 1, viewpoint)])


def _report(about: dict[str, Any]) -> str:
    cpu = about["machine"]
    lines = [
        f"# What an object store costs a capture ({about['date']})",
        "",
        f"`python -m bench.record.spool_cost`; commit {about['commit']}; {cpu['processor']}, {cpu['cores']} cores, "
        f"Python {cpu['python']}, load {about['load']};",
        f"{about['captures_of_each_kind']} captures of each kind, one of each in turn, "
        f"{about['photograph_megabytes']:g} MB each, {about['pause_s']:g} s between two. The store is SeaweedFS on "
        "the same machine.",
        "",
        "| data folder | median ms | 95th percentile ms | ratio of medians | median of the ratios of pairs |",
        "|---|---|---|---|---|",
    ]
    for name in (ABSENT, PRESENT, AWAY):
        figures = " | ".join(str(about[key][name]) for key in _FIGURES)
        lines.append(f"| {name} | {figures} |")
    names = sorted({call for done in about["done"].values() for call in done})
    lines += ["", f"All {about['captures_of_each_kind']} captures of a kind did, together:", ""]
    lines += [f"| data folder | {' | '.join(names)} |", f"|---{'|---' * len(names)}|"]
    for name in KINDS:
        lines.append(f"| {name} | {' | '.join(str(about['done'][name].get(call, 0)) for call in names)} |")
    lines += ["", _READS]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
