"""A completed run on which methods of reconstruction are run, and a package with a method that some machines have."""

from __future__ import annotations

import json
import sys
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from service.audit.recorded_run import read_run
from service.cli.main import app
from service.core.records.events import Event
from service.core.records.run_events import JobEnqueued, JobFailed, JobFinished
from service.machine.executors import VARIABLE
from service.store.store import Store
from service.worker.loop import work
from tests.support.processes.method_plugin import MODULE, TRUTH, method_plugin
from tests.support.recorded.unpacked_run import unpack_recorded_run

_Payload = TypeVar("_Payload", JobEnqueued, JobFailed, JobFinished)
METHOD, SHIFT_M = "shifted-truth", 5e-4
ASKED = ("--scenario", "sparse", "--width", "200", "--spacing-mm", "2", "--operator", "Erika")


@dataclass(frozen=True)
class BenchmarkedRun:
    """A data folder with a completed run, and a package with a method, which only some machines have."""

    folder: Path  # of the package and of the mesh that it needs
    data: Path

    @contextmanager
    def machine(self, *, method: bool, truth: bool = True, scheduler: str = "") -> Generator[None]:
        """Be a machine with or without the package, and with or without what the method needs besides.

        `scheduler`: the address of the cluster that the environment names.
        """
        with pytest.MonkeyPatch.context() as patch:
            if method:
                patch.syspath_prepend(str(self.folder / "package"))
            if truth:
                patch.setenv(TRUTH, str(self.folder / "truth.ply"))
            if scheduler:
                patch.setenv(VARIABLE, scheduler)
            try:
                yield
            finally:
                sys.modules.pop(MODULE, None)

    def call(self, *command: str) -> tuple[int, Any]:
        """The exit status of a command, and what it prints with --json."""
        done = CliRunner().invoke(app, [*command, "--data", str(self.data), "--json"], catch_exceptions=False)
        return done.exit_code, json.loads(done.stdout)

    def ask(self, *command: str, method: str = METHOD) -> dict[str, Any]:
        """Ask for a benchmark of the run, and do not wait."""
        with self.machine(method=True, truth=False):
            status, printed = self.call(
                "benchmark", "run", "latest", "--method", method, *ASKED, "--no-wait", *command
            )
        assert status == 0, printed
        return printed

    def cancel(self, job: str) -> None:
        """End a benchmark by a person's decision."""
        assert self.call("cancel", job, "--reason", "asked by mistake", "--operator", "Erika")[0] == 0

    def worker(self, data: Path | None = None, *, scheduler: str = "", **has: bool) -> int:
        """The number of jobs that a worker of a machine computes until none is left for it, here or on a folder."""
        with self.machine(**has, scheduler=scheduler), Store.open(data or self.data) as store:
            return work(store, until_idle=True, stop=lambda: False, progress=lambda *_: None)

    def event(self, kind: type[_Payload], job: str) -> tuple[Event, _Payload]:
        """The event of a kind that names a job, and its payload."""
        with Store.open(self.data) as store:
            found = store.events(store.find_run("latest"))
        ((event, payload),) = [(e, e.payload) for e in found if isinstance(e.payload, kind) and e.payload.job == job]
        return event, payload


def unpack_benchmarked_run(folder: Path) -> BenchmarkedRun:
    """Unpack the recorded run into a folder, and install the method beside it."""
    data = unpack_recorded_run(folder)
    method_plugin(folder / "package")
    mesh = read_run(data, "latest").summary().ground_truth().mesh
    shifted_m = mesh.vertices_m + np.array([0.0, 0.0, SHIFT_M])
    trimesh.Trimesh(shifted_m, mesh.faces, process=False).export(folder / "truth.ply")
    return BenchmarkedRun(folder, data)
