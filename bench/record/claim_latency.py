"""How soon a job of a site is claimed, and how fast: `python -m bench.record.claim_latency` (needs PostgreSQL).

A worker that is idle polls five times a second, or hears of the job from the server. Then four processes claim and
finish many empty jobs, claiming with the site's write lock as the program does, and with FOR UPDATE SKIP LOCKED in
SQL of this bench.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import threading
import time
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import text

from bench.machine import RESULTS, commit, machine
from service.store.database.database import Changes, PolledChanges
from service.store.durable_effects import SystemClock
from service.store.jobs import to_job
from service.store.records import NewJob
from service.store.store import Store
from tests.support.processes.postgres import Cluster
from tests.support.record.store import start_run

_POLL_S = 0.2  # as service.worker.loop
_SAMPLES, _JOBS, _WORKERS = 30, 200, 4
_SKIP = text(
    "UPDATE jobs SET state = 'running', tries = tries + 1, worker = :worker, token = :worker WHERE job_id = "
    "(SELECT job_id FROM jobs WHERE state = 'queued' ORDER BY priority, position LIMIT 1 FOR UPDATE SKIP LOCKED) "
    "RETURNING *"
)


def latencies_ms(site: Path, *, heard: bool) -> list[float]:
    """Milliseconds from when a job is recorded to when an idle worker has claimed it."""
    claimed: list[float] = []
    over = threading.Event()

    def work() -> None:
        with Store.open(site) as store:
            polled: Changes = PolledChanges(SystemClock())
            with closing(store.changes("jobs") if heard else polled) as changes:
                while not over.is_set():
                    if store.claim_job("worker", 60.0) is None:
                        changes.wait(_POLL_S)
                    else:
                        claimed.append(time.monotonic())

    worker = threading.Thread(target=work)
    with Store.open(site) as store:
        run_id = start_run(store)
        worker.start()
        found: list[float] = []
        for n in range(_SAMPLES):
            time.sleep(0.5 + 0.013 * n % 0.2)  # at every moment between two polls
            store.record(run_id, [], actor="bench", jobs=[NewJob("detect", "s", 1, f"{n}", {})])
            recorded = time.monotonic()
            while len(claimed) <= n:
                time.sleep(0.0005)
            found.append(max(0.0, claimed[n] - recorded) * 1e3)
        over.set()
        worker.join()
    return found


def claim_all(site: Path, name: str, skip: bool, results: Any, over: Any) -> None:
    """Claim and finish until no job is left, and report when that was and how many there were."""
    count = 0
    with Store.open(site) as store:
        results.put("ready")
        if skip:
            with store.database.reading() as connection:
                engine = connection.engine
            while True:
                with engine.begin() as connection:
                    row = connection.execute(_SKIP, {"worker": name}).first()
                if row is None:
                    break
                store.finish_job(to_job(row), measures={}, duration_s=0.0)
                count += 1
        else:
            while (job := store.claim_job(name, 60.0)) is not None:
                store.finish_job(job, measures={}, duration_s=0.0)
                count += 1
    results.put((count, time.monotonic()))
    over.wait()  # the jobs of a process that has ended would be claimed again


def claims_a_second(cluster: Cluster, folder: Path, *, skip: bool) -> tuple[float, int]:
    """Jobs a second of all workers together, and their number."""
    site = cluster.site(folder)
    with Store.open(site) as store:
        new = [NewJob("detect", "s", 1, f"{n}", {}) for n in range(_JOBS)]
        store.record(start_run(store), [], actor="bench", jobs=new)
    context = multiprocessing.get_context("fork")
    results: Any = context.Queue()
    over: Any = context.Barrier(_WORKERS)
    workers = [context.Process(target=claim_all, args=(site, f"w{n}", skip, results, over)) for n in range(_WORKERS)]
    began = time.monotonic()
    for worker in workers:
        worker.start()
    answers = [results.get() for _ in range(2 * _WORKERS)]
    ends = [answer for answer in answers if answer != "ready"]
    for worker in workers:
        worker.join()
    return sum(count for count, _ in ends) / (max(end for _, end in ends) - began), sum(count for count, _ in ends)


def main() -> int:
    """Measure, print and write the figures."""
    cluster = Cluster()
    cluster.start()
    try:
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            waited = {
                name: latencies_ms(cluster.site(work / name), heard=name == "heard") for name in ("polled", "heard")
            }
            claims: dict[str, list[float]] = {"site's lock": [], "SKIP LOCKED": []}
            for turn in range(3):
                for name, rates in claims.items():
                    skip = name == "SKIP LOCKED"
                    rate, count = claims_a_second(cluster, work / f"{turn}{skip}", skip=skip)
                    assert count == _JOBS, count
                    rates.append(rate)
    finally:
        cluster.stop()
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": round(os.getloadavg()[0], 1),
        "median_ms": {name: round(statistics.median(found), 1) for name, found in waited.items()},
        "p95_ms": {name: round(statistics.quantiles(found, n=20)[-1], 1) for name, found in waited.items()},
        "jobs_per_s": {name: round(statistics.median(rates)) for name, rates in claims.items()},
    }
    report = _report(about)
    sys.stdout.write(report)
    path = RESULTS / f"claim_latency-{about['date']}.json"
    path.write_text(json.dumps(about, indent=2) + "\n")
    path.with_suffix(".md").write_text(report)
    return 0


def _report(about: dict[str, Any]) -> str:
    cpu = about["machine"]
    lines = [
        f"# How soon a job of a site is claimed ({about['date']})",
        "",
        f"`python -m bench.record.claim_latency`; commit {about['commit']}; {cpu['processor']}, "
        f"{cpu['cores']} cores, Python {cpu['python']}, load {about['load']}; PostgreSQL on the same machine.",
        "",
        f"| an idle worker, {_SAMPLES} jobs | median ms | 95th percentile ms |",
        "|---|---|---|",
        *(f"| {name} | {about['median_ms'][name]} | {about['p95_ms'][name]} |" for name in about["median_ms"]),
        "",
        f"| {_WORKERS} processes claim and finish {_JOBS} empty jobs, each once; median of 3 | jobs a second |",
        "|---|---|",
        *(f"| {name} | {rate} |" for name, rate in about["jobs_per_s"].items()),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
