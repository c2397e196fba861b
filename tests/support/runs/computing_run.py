"""A small run whose jobs are computed in the same process, while it waits for them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

from drivers.interfaces import Scanner
from drivers.scan_folder import ScanFolder, ScanFolderConfig
from service.store.store import Store
from service.worker.loop import work
from tests.support.rig.bench_rig import BenchRig
from tests.support.runs.bench_run import Bench, begin_run

# A run of one step, whose scan has a texture.
TEXTURED = """\
id: textured
version: "1"
title: A textured scan
spheres: {radius_mm: 6, registration: 5, control: 0}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: scan
    kind: scan_import
    title: Scan
    confirm: false
    params: {spheres: 5, wait_s: 20}
"""


class OneScanner(BenchRig):
    """The bench with a scanner that writes its meshes, in millimetres, into a folder."""

    folder: Path

    def scanner(self, name: str | None = None) -> Scanner:
        return cast(Scanner, ScanFolder(ScanFolderConfig(folder=self.folder, stable_s=0, unit="mm")))


def begin_computing_run(store: Store, text: str, folder: Path, rig: BenchRig) -> Bench:
    """Begin a run of a protocol text on a rig; whenever it waits, all jobs that are due are computed."""
    bench = replace(begin_run(store, text, folder), rig=rig)

    def compute(_seconds: float) -> None:
        compute_jobs(store)

    bench.on_wait = compute
    return bench


def compute_jobs(store: Store) -> int:
    """Compute the jobs that are due, and those that follow from them; returns how many were computed."""
    return work(store, until_idle=True, stop=lambda: False, progress=lambda _what, _done, _all: None)
