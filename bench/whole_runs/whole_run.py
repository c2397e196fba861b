"""One whole protocol on a simulated rig, run as by a user: each command is measured, figures come from the record."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from bench.machine import REPOSITORY
from service.cli.demo import true_errors_mm
from service.core.records.run_events import RunReleased
from service.dataset.summary import RunSummary, summarise
from service.run_start import recorded_run
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from tests.support.recorded.run_figures import run_figures

SECOND_PERSON = "second person of the bench"
_WATCH_S = 0.5


@dataclass(frozen=True, slots=True)
class Measured:
    """One command: its exit, its duration, and the peak memory of all its processes together."""

    status: int
    seconds: float
    peak_mb: float
    answer: str  # last line of its standard output
    complaint: str  # last lines of its standard error

    def figures(self) -> dict[str, Any]:
        """Convert to JSON data."""
        figures: dict[str, Any] = {"seconds": round(self.seconds, 1), "peak_mb": round(self.peak_mb)}
        if self.status:
            figures |= {"status": self.status, "complaint": self.complaint}
        return figures


def orthocapture(*words: str, timeout_s: float, log: Path) -> Measured:
    """Run the command to its end while monitoring the memory of its process tree."""
    begun_s = time.monotonic()
    with log.open("w+") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "service.cli.main", *words],
            cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, text=True,
        )  # fmt: skip
        peak_mb = [0.0]
        watcher = threading.Thread(target=_watch, args=(process.pid, peak_mb), daemon=True)
        watcher.start()
        try:
            output, _ = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            process.terminate()
            output, _ = process.communicate(timeout=60)
        watcher.join()
        errors.seek(0)
        complaint = errors.read().strip().splitlines()[-6:]
    lines = output.strip().splitlines()
    seconds = time.monotonic() - begun_s
    return Measured(process.returncode, seconds, peak_mb[0], lines[-1] if lines else "", "\n".join(complaint))


def _watch(pid: int, peak_mb: list[float]) -> None:
    """Sum the resident memory of a process tree until it ends; shared pages count once per process."""
    while True:
        total = 0
        try:
            top = psutil.Process(pid)
            if top.status() == psutil.STATUS_ZOMBIE:
                return
            for process in (top, *top.children(recursive=True)):
                try:
                    total += process.memory_info().rss
                except psutil.NoSuchProcess:
                    continue
        except psutil.NoSuchProcess:
            return
        peak_mb[0] = max(peak_mb[0], total / 1e6)
        time.sleep(_WATCH_S)


@contextmanager
def simulated_rig(folder: Path, scene: int, options: Sequence[str]) -> Generator[Mapping[str, str]]:
    """Start a rig around one scene; yields its ready line."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "rig.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "service.cli.main", "simulate", "rig", "--scene", str(scene), "--dir",
             str(folder), *options],
            cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(f"the rig did not start: {(folder / 'rig.log').read_text()[-500:]}")
            yield json.loads(line)
        finally:
            process.terminate()
            process.wait(timeout=60)
            if process.stdout is not None:
                process.stdout.close()


def whole_run(
    protocol: Path,
    scene: int,
    folder: Path,
    rig_options: Sequence[str],
    *,
    speed_up: float,
    timeout_s: float,
    replayed: bool,
) -> dict[str, Any]:
    """Run, verify, replay, report and bundle one scene; returns the figures, and any errors.

    Args:
        protocol: the protocol file.
        scene: seed of the simulated scene.
        folder: for the rig, the evidence and the exports.
        rig_options: further options of `simulate rig`.
        speed_up: of the simulated arm, as in the rig's options.
        timeout_s: of each command.
        replayed: recompute the whole run, which takes as long as the run's own computations.
    """
    with simulated_rig(folder / "rig", scene, rig_options) as ready:
        data = folder / "data"
        run = orthocapture(
            "run", str(protocol), "--rig", ready["rig"], "--data", str(data), "--operator", "bench", "--auto-confirm",
            "--json", timeout_s=timeout_s, log=folder / "run.log",
        )  # fmt: skip
        truth = Path(ready["truth"])
    record: dict[str, Any] = {"scene": scene, "run": run.figures()}
    if not (data / "orthocapture.sqlite").exists():
        return record
    with Store.open(data, create=False) as store:
        summary = summarise(store, store.find_run("latest"), recorded_run(store, store.find_run("latest"))[0])
        record |= {"status": summary.state.status, "at": summary.state.current}
        record |= {"deviations": [d.text for d in summary.state.deviations]}
        record["table"] = _table(summary, truth)
        record["figures"] = run_figures(summary, speed_up)
        record["bytes"] = _bytes(data)
        if summary.state.status == "completed":
            _release(store, summary)
            record["commands"] = _commands(summary.run_id, data, folder, timeout_s, replayed)
    return record


def _table(summary: RunSummary, truth: Path) -> list[dict[str, Any]]:
    rows = summary.table()
    if not rows:
        return []
    true_mm = true_errors_mm(summary, truth)
    columns = ("poses", "mean_radial_error_mm", "mean_reprojection_error_px")
    return [{**{c: row.plain()[c] for c in columns}, "true_error_mm": true_mm.get(row.poses)} for row in rows]


def _release(store: Store, summary: RunSummary) -> None:
    """Release the run as a second person, so that the bundle can be exported."""
    payload = RunReleased(meaning="released by the bench", signed_sha256=summary.state.completed_sha256)
    store.record(summary.run_id, [payload], actor=SECOND_PERSON)
    checkpoint(store, summary.run_id)


def _commands(run_id: str, data: Path, folder: Path, timeout_s: float, replayed: bool) -> dict[str, Any]:
    """Run every command that reads a finished run."""
    common = ("--data", str(data), "--json")
    words = {
        "verify": ("audit", "verify", run_id, *common),
        "replay": ("replay", run_id, *common),
        "report": ("audit", "report", run_id, "--pdf", str(folder / "report.pdf"), *common),
        "bundle": ("audit", "export", run_id, str(folder / "bundle.zip"), *common),
    }
    if not replayed:
        del words["replay"]
    found: dict[str, Any] = {}
    for name, line in words.items():
        measured = orthocapture(*line, timeout_s=timeout_s, log=folder / f"{name}.log")
        found[name] = measured.figures()
    for name in ("report.pdf", "bundle.zip"):
        if (folder / name).exists():
            found[name] = {"bytes": (folder / name).stat().st_size}
    return found


def _bytes(data: Path) -> dict[str, int]:
    files = [entry for entry in (data / "artefacts").rglob("*") if entry.is_file()]
    database = sum(entry.stat().st_size for entry in data.glob("orthocapture.sqlite*"))
    return {
        "artefacts": sum(entry.stat().st_size for entry in files),
        "files": len(files),
        "database": database,
        "free_before_the_next": os.statvfs(data).f_bavail * os.statvfs(data).f_frsize,
    }
