"""What an object store costs a capture: `python -m bench.record.spool_cost`; with it, without it, and with it away.

A capture is one photograph with its row and event. Three data folders take them in turn, at the pace of a fast rig:
one without a site.yaml, one whose uploader uploads meanwhile to a SeaweedFS on this machine, and one whose uploader
finds no server. The server competes for the processor here, as it would not on a machine of its own.
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
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from bench.machine import RESULTS, commit, machine
from service.store.data_folder import object_store_of
from service.store.objects.copies import read_waiting
from service.store.records import NewArtefact
from service.store.store import Store
from tests.support.processes.object_store import Weed
from tests.support.record.store import captured, start_run

ABSENT, PRESENT, AWAY = "no object store", "object store present", "object store away"
_ROUND = 15  # captures into one folder before the next one's turn, so that all meet the same load of the machine


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--megabytes", type=float, default=8.0, help="size of a photograph")
    parser.add_argument("--pause-s", type=float, default=0.4, help="between two captures")
    parser.add_argument("--folder", type=Path, default=None, help="on the disk to measure")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as work, ExitStack() as stack:
        times = _measure(Path(work), stack, options.rounds, int(1e6 * options.megabytes), options.pause_s)
    medians = {name: statistics.median(found) for name, found in times.items()}
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "captures_of_each_kind": options.rounds * _ROUND,
        "photograph_megabytes": options.megabytes,
        "pause_s": options.pause_s,
        "median_ms": {name: round(found, 3) for name, found in medians.items()},
        "p95_ms": {name: round(sorted(found)[int(0.95 * len(found))], 3) for name, found in times.items()},
        "ratio_of_medians": {name: round(found / medians[ABSENT], 4) for name, found in medians.items()},
    }
    text = _report(about)
    sys.stdout.write(text)
    stem = options.results / f"spool_cost-{about['date']}"
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return 0


def _measure(work: Path, stack: ExitStack, rounds: int, size_bytes: int, pause_s: float) -> dict[str, list[float]]:
    """Milliseconds of each capture, by kind."""
    server = Weed(work / "server")
    gone = Weed(work / "gone")  # never started: nobody listens there
    server.start()
    stack.callback(server.kill)
    server.write_site(work / PRESENT)
    gone.write_site(work / AWAY)
    stores = {name: stack.enter_context(Store.open(work / name)) for name in (ABSENT, PRESENT, AWAY)}
    runs = {name: start_run(store) for name, store in stores.items()}
    for name in (PRESENT, AWAY):
        command = [
            sys.executable,
            "-m",
            "service.cli.main",
            "store",
            "upload",
            "--follow",
            "--data",
            str(work / name),
        ]
        process = subprocess.Popen(command)
        stack.callback(process.wait)
        stack.callback(process.terminate)
    random = np.random.default_rng(0)
    times: dict[str, list[float]] = {name: [] for name in stores}
    for number in range(rounds):
        order = list(stores)
        for name in order[number % 3 :] + order[: number % 3]:
            for shot in range(_ROUND):
                photograph = random.bytes(size_bytes)
                begun_s = time.perf_counter()
                _capture(stores[name], runs[name], f"v{number}_{shot}", photograph)
                times[name].append(1e3 * (time.perf_counter() - begun_s))
                time.sleep(pause_s)
            if name == PRESENT:
                _drained(work / name, stores[name])
    return times


def _capture(store: Store, run_id: str, viewpoint: str, photograph: bytes) -> None:
    ref = store.put_bytes(photograph, kind="image", media_type="image/jpeg", original_name=f"{viewpoint}.jpg")
    payload = captured(ref, viewpoint)
    store.record(run_id, [payload], actor="runner", artefacts=[NewArtefact(ref, "camera", "capture", 1, viewpoint)])


def _drained(data: Path, store: Store) -> None:
    """Wait until the uploader has nothing left, so that the next folder's captures do not meet its uploads."""
    section = object_store_of(data)
    assert section is not None
    while True:
        with store.database.reading() as connection:
            if not read_waiting(connection, section.place).files:
                return
        time.sleep(0.2)


def _report(about: dict[str, Any]) -> str:
    cpu = about["machine"]
    lines = [
        f"# What an object store costs a capture ({about['date']})",
        "",
        f"`python -m bench.record.spool_cost`; commit {about['commit']}; {cpu['processor']}, {cpu['cores']} cores, "
        f"Python {cpu['python']}, load {about['load']};",
        f"{about['captures_of_each_kind']} captures of each kind in turn, {about['photograph_megabytes']:g} MB each, "
        f"{about['pause_s']:g} s between two. The store is SeaweedFS on the same machine and competes for it.",
        "",
        "| data folder | median ms | 95th percentile ms | ratio of medians |",
        "|---|---|---|---|",
    ]
    for name in (ABSENT, PRESENT, AWAY):
        figures = " | ".join(str(about[key][name]) for key in ("median_ms", "p95_ms", "ratio_of_medians"))
        lines.append(f"| {name} | {figures} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
