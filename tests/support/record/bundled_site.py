"""A completed run with its evidence bundle, and the bundle's verifier."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.audit import bundle_verifier
from service.audit.bundle import export_bundle
from service.store.records import NewArtefact, NewJob
from service.store.signatures.signing import checkpoint, rotate_key
from service.store.store import Store
from tests.support.record.outsider import copy_data
from tests.support.record.store import enqueue
from tests.support.runs.bench_run import PROTOCOL, begin_run


@dataclass(frozen=True)
class Site:
    """A data folder with a completed run, and its bundle, packed and unpacked."""

    data: Path
    run_id: str
    bundle: Path
    folder: Path
    key_id: str


def record(folder: Path, protocol: str = PROTOCOL) -> tuple[Path, str]:
    """Record a completed run with a job and a changed key; returns the data folder and the run's id."""
    with Store.open(folder / "data") as store:
        bench = begin_run(store, protocol, folder)
        enqueue(store, bench.run_id, NewJob("detect", "fixation", 1, "key", {"of": "x"}), actor="runner")
        job = store.claim_job("worker 1", 10)
        assert job is not None
        ref = store.put_bytes(b"{}", kind="result", media_type="application/json", original_name="result.json")
        store.finish_job(job, measures={}, duration_s=1.0, artefacts=[NewArtefact(ref, "worker 1")])
        assert bench.run().status == "completed"
        checkpoint(store, bench.run_id)
        rotate_key(store, reason="yearly", actor="ada")
        return folder / "data", bench.run_id


def bundled_site(folder: Path) -> Site:
    """Make the run and its bundle in an empty folder."""
    data, run_id = record(folder)
    copy_data(data, folder / "before")
    with Store.open(data) as store:
        made = export_bundle(store, run_id, folder / "bundle.zip", actor="ada")
    with zipfile.ZipFile(made.path) as archive:
        archive.extractall(folder / "unpacked")
    return Site(data, run_id, made.path, folder / "unpacked", made.key_id)


def check(path: Path, **options: Any) -> list[str]:
    """The faults that the verifier names when called in this process."""
    found = bundle_verifier.Check()
    found.run(path, options.get("key"), options.get("certificates"))
    return [f"{fault['where']}: {fault['what']}" for fault in found.faults]


def run_verifier(script: Path, *arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the verifier as elsewhere: nothing of this project can be imported."""
    words = [sys.executable, "-I", str(script), *arguments]
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, timeout=60, check=False)
