"""`together`: one runner, four workers, eight readers, a person and a web process on one database for minutes.

Each is a process (roles.py) that works as fast as it can and logs every duration and error. No lock error may reach
anybody, and nobody may wait longer than WAIT_S for an answer.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from service.core.protocol import parse_protocol
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.serving import serving
from tests.support.rig.rig import REPOSITORY
from tests.support.runs.bench_run import PROTOCOL

WAIT_S = 10.0
WORKERS = 4
READERS = ("status", "status", "status", "pages", "pages", "pages", "audit show", "audit show")
_PLANNED = 800  # viewpoints per minute, more than can be taken
_GRACE_S = 60.0
_BEGUN_S = 240.0  # until every process has done something once


def together(folder: Path, minutes: float) -> dict[str, Any]:
    """Run all processes for `minutes`; returns what each did and how long it waited, and the faults."""
    folder.mkdir(parents=True, exist_ok=True)
    rig = folder / "rig.yaml"
    rig.write_text("name: together\nsimulated: true\ndevices: {}\n")
    data = folder / "data"
    loaded = parse_protocol(
        PROTOCOL.replace("count: 4", f"count: {int(200 + _PLANNED * minutes)}").encode(),
        params_models(),
        name="bench.yaml",
    )
    with Store.open(data) as store:
        run_id = start_run(store, loaded, load_rig(rig), operator="Ada", auto_confirm=False)
    names = ["runner", *("worker" for _ in range(WORKERS)), *READERS, "person"]
    with serving(rig) as server:
        cookie = server.signed_in()["Cookie"]
        roles = [_Role(folder, number, name, run_id, server.url, cookie) for number, name in enumerate(names)]
        try:
            _all_begun(roles)
            print(f"together: {len(roles)} processes and the web for {minutes:g} minutes", flush=True)
            ends_s = time.monotonic() + 60 * minutes
            while time.monotonic() < ends_s and all(role.process.poll() is None for role in roles):
                time.sleep(0.2)
            broken = [f"{role.name} ended by itself: {role.complaint()}" for role in roles if role.process.poll()]
        finally:
            for role in roles:
                role.process.terminate()
            for role in roles:
                role.end()
    report = verify(data)
    with Store.open(data) as store:
        head, jobs = store.head(run_id), store.jobs(run_id)
        captured = sum(event.payload.kind == "viewpoint_captured" for event in store.events(run_id))
    rows = [_row(name, [role for role in roles if role.name == name]) for name in dict.fromkeys(names)]
    faults = broken + [fault for row in rows for fault in row["faults"]] + [str(fault) for fault in report.faults]
    faults += _told_of_locks(data)
    if not captured or not any(job.state == "finished" for job in jobs):
        faults.append("nothing was captured or computed: this says nothing")
    return {
        "minutes": minutes,
        "events": head,
        "captured": captured,
        "jobs": {state: sum(job.state == state for job in jobs) for state in sorted({job.state for job in jobs})},
        "wait_s": WAIT_S,
        "rows": rows,
        "faults": faults,
    }


class _Role:
    """One process and its log."""

    def __init__(self, folder: Path, number: int, name: str, run_id: str, url: str, cookie: str) -> None:
        self.name = name
        self.log = folder / f"role-{number}.jsonl"
        self.errors = folder / f"role-{number}.stderr"
        words = [name, str(folder / "data"), run_id, str(self.log), url, cookie]
        with self.errors.open("wb") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.support.soak.roles", *words],
                cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr,
            )  # fmt: skip

    def lines(self) -> list[dict[str, Any]]:
        """The log lines written so far."""
        whole = self.log.read_text().rpartition("\n")[0] if self.log.exists() else ""
        return [json.loads(line) for line in whole.splitlines()]

    def complaint(self) -> str:
        """The end of its standard error."""
        return self.errors.read_text().strip()[-400:]

    def end(self) -> None:
        """Wait until the process has ended after being told to; kill it if it does not."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=_GRACE_S)
            return
        self.process.kill()
        self.process.wait()


def _all_begun(roles: Sequence[_Role]) -> None:
    ends_s = time.monotonic() + _BEGUN_S
    while time.monotonic() < ends_s:
        done = [role for role in roles if role.lines()]
        if {role.name for role in done} == {role.name for role in roles}:
            return
        if any(role.process.poll() is not None for role in roles):
            return
        time.sleep(0.1)


def _row(name: str, roles: Sequence[_Role]) -> dict[str, Any]:
    lines = [line for role in roles for line in role.lines()]
    taken = [line["seconds"] for line in lines if "seconds" in line]
    errors = Counter(line["error"] for line in lines if "error" in line)
    faults = [f"{name}, {times} times: {error}" for error, times in errors.most_common(5)]
    if not taken:
        faults.append(f"{name} did nothing: {roles[0].complaint()}")
        return {"who": name, "processes": len(roles), "times": 0, "faults": faults}
    late = [s for s in taken if s > WAIT_S]
    if late and name not in ("runner", "worker"):  # these do not keep a person waiting
        faults.append(
            f"{name} waited {max(late):.1f} s, longer than {WAIT_S:g} s ({len(late)} of {len(taken)} times)"
        )
    middle, late_s = (float(np.percentile(taken, share)) for share in (50, 99))
    return {
        "who": name,
        "processes": len(roles),
        "times": len(taken),
        "median_s": round(middle, 4),
        "p99_s": round(late_s, 4),
        "longest_s": round(max(taken), 4),
        "faults": faults,
    }


def _told_of_locks(data: Path) -> list[str]:
    """Reports of a locked database in the processes' logs."""
    text = "\n".join(path.read_text() for path in sorted((data / "logs").glob("*.jsonl")))
    return [f"in the log: {line[:300]}" for line in text.splitlines() if "database is locked" in line]


def table(found: dict[str, Any]) -> list[str]:
    """Format the findings as Markdown lines."""
    jobs = ", ".join(f"{count:,} {state}" for state, count in found["jobs"].items())
    lines = [
        f"{found['minutes']:g} minutes on one database file: {found['events']:,} events, {found['captured']:,} "
        f"viewpoints; jobs: {jobs}. Seconds of each answer; nobody may wait longer than {found['wait_s']:g} s. "
        "All of them share two cores and work without a pause, so that most of a wait is for the processor.",
        "",
        "| who | processes | times | median (s) | 99 % (s) | longest (s) | |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    for row in found["rows"]:
        keys = ("median_s", "p99_s", "longest_s")
        figures = " | ".join(f"{row[key]:.3f}" if key in row else "–" for key in keys)
        verdict = "; ".join(row["faults"][:3]) or "ok"
        lines.append(f"| {row['who']} | {row['processes']} | {row['times']:,} | {figures} | {verdict} |")
    return lines
