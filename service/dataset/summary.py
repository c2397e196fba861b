"""Sums up a finished or stopped run from its evidence alone, as report and data set need it, with its fusion."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

import numpy as np

from service.computations import fuse
from service.computations.evaluate import ErrorBudget, Row
from service.computations.records import Point, SpheresFound
from service.computations.registration import Registration
from service.compute.surfaces.surface import read_ply
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, align_points, apply
from service.core.protocol import Protocol
from service.core.records.base import ArtefactRef
from service.core.records.run_events import JobFinished, RecordedView
from service.core.run.fold import FoldedRun, fold
from service.core.run.state import JobState, RunState
from service.core.units import metres
from service.dataset.records import Mesh
from service.dataset.registrations import (
    better_later,
    budgets,
    evaluated,
    own_registration,
    registrations,
    result_of_step,
)
from service.store.store import Store


def registered_scan(protocol: Protocol, state: RunState) -> str:
    """Return the step whose scan the last registration used; before there is one, the last scan; "" without any."""
    scans = [step.id for step in reversed(protocol.steps) if step.gives == "scan_surface"]
    for step in reversed(protocol.steps):
        if step.gives == "registrations" and state.steps[step.id].result:
            named = str(step.params.model_dump().get("scan") or "")
            return named if named in scans else ""
    return next((step for step in scans if state.steps[step].result), "")


def control_scan(protocol: Protocol) -> str:
    """Return the step whose scan still shows the control spheres, as the last evaluation names it; "" without any."""
    judged = next((step for step in reversed(protocol.steps) if step.gives == "accuracy"), None)
    return "" if judged is None else str(judged.params.model_dump().get("control_scan") or "")


class ArtefactReader(Interface):
    """Finds the files of the evidence."""

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Return the path of an artefact's read-only file.

        Raises IntegrityError if missing or, with `verify`, if altered.
        """
        ...


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The mesh of the data set.

    Attributes:
        words: a text on what it is.
        sha256: hash of its file.
        mesh: the mesh in the frame of the scan; a scan has neither sources nor standard deviations.
    """

    words: str
    sha256: str
    mesh: Mesh = field(repr=False)


@dataclass(frozen=True, slots=True)
class RunSummary(FoldedRun):
    """The record of one run, and what reads its files."""

    store: ArtefactReader

    def registrations(self) -> Mapping[str, Registration]:
        """Return registrations by name, including those that arrived after the step's decision."""
        return registrations(self.protocol, self.state)

    def table(self) -> Sequence[Row]:
        """Return the paper's table: control sphere errors for each source of poses, including late arrivals."""
        return evaluated(self.protocol, self.state)

    def budgets(self) -> Mapping[str, ErrorBudget]:
        """Return the error budget of each evaluated registration."""
        return budgets(self.protocol, self.state)

    def best(self) -> str | None:
        """Name of the run's own registration: the best that the evaluation step judged (registrations.py)."""
        return own_registration(self.protocol, self.state)

    def better_later(self) -> Row | None:
        """Return the row of a registration that arrived after the evaluation and beats the run's own, if any."""
        return better_later(self.protocol, self.state)

    def captures(self) -> Iterable[RecordedView]:
        """Yield every valid capture in order, including those for calibration."""
        seqs = sorted(seq for step in self.state.steps.values() for seq in step.captured.values())
        payloads = (self.events[seq - 1].payload for seq in seqs)
        return (payload for payload in payloads if isinstance(payload, RecordedView))

    def artefacts(self, kind: str) -> tuple[ArtefactRef, ...]:
        """Return artefacts of a kind in the results of the run's valid steps."""
        refs = (ref for s in self.protocol.steps for ref in self.state.steps[s.id].artefacts)
        return tuple(ref for ref in refs if ref.kind == kind)

    def jobs(self) -> Sequence[JobFinished]:
        """Return all finished jobs."""
        return [event.payload for event in self.events if isinstance(event.payload, JobFinished)]

    def scan_spheres_m(self) -> tuple[Point, ...]:
        """Return sphere centres of the registered scan in its own frame; empty before a scan was imported."""
        step = registered_scan(self.protocol, self.state)
        known = step and self.state.steps[step].result
        return result_of_step(self.state, step, SpheresFound).spheres_m if known else ()

    def scan_mesh_file(self) -> ArtefactRef | None:
        """Return the file of the registered scan's mesh; None before it was imported."""
        step = registered_scan(self.protocol, self.state)
        kept = self.state.steps[step].artefacts if step else ()
        return next((ref for ref in reversed(kept) if ref.kind == "scan_mesh"), None)

    def scan_mesh(self) -> tuple[Array, Any]:
        """Return vertices (V, 3) in metres and faces (F, 3) of the registered scan.

        Raises DataError if there is none.
        """
        ref = self.scan_mesh_file()
        if ref is None:
            raise DataError("the run has no scan", where=self.run_id, remedy="Import the scan")
        with np.load(self.store.artefact_path(ref.sha256), allow_pickle=False) as mesh:
            return mesh["vertices_m"], mesh["faces"]

    def ground_truth(self) -> GroundTruth:
        """Return the data set's mesh, in the scan's frame: CT and scan fused if the run has that, else the scan."""
        fused = self.artefacts("ground_truth_mesh")
        if not fused:
            vertices_m, faces = self.scan_mesh()
            scan = self.scan_mesh_file()
            sha256 = "" if scan is None else scan.sha256
            return GroundTruth("scan", sha256, Mesh(np.asarray(vertices_m, dtype=np.float64), faces.astype(np.int64)))
        columns, faces = read_ply(self.store.artefact_path(fused[-1].sha256))
        vertices_mm = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        source, sigma_m = columns["source"].astype(np.uint8), metres(columns["sigma_mm"].astype(np.float64))
        return GroundTruth("CT and scan, fused", fused[-1].sha256, Mesh(metres(vertices_mm), faces, source, sigma_m))


def summarise(store: Store, run_id: str, protocol: Protocol) -> RunSummary:
    """Read a run and fold its events."""
    events = store.events(run_id)
    return RunSummary(run_id, protocol, events, fold(protocol, events), store)


MESH = "ground_truth_mesh"  # kind of the mesh's artefact


@dataclass(frozen=True, slots=True)
class RecordedFusion:
    """The recorded fusion from which the data set's mesh comes.

    Attributes:
        step: its step's title.
        answer: the job's answer.
        measures: the job's measures, by name.
        spacing_m: spacing of the samples for its Chamfer distance.
        files: its artefacts by kind.
    """

    step: str
    answer: fuse.Answer
    measures: Mapping[str, float]
    spacing_m: float
    files: Mapping[str, ArtefactRef] = field(repr=False)


def recorded_fusion(summary: RunSummary) -> RecordedFusion | None:
    """Return the fusion whose mesh is the run's ground truth; None if that is the scan.

    Raises:
        DataError: the job that made the mesh is not in the record.
    """
    meshes = summary.artefacts(MESH)
    if not meshes:
        return None
    for step in reversed(summary.protocol.steps):
        for job in summary.state.steps[step.id].jobs.values():
            files = {ref.kind: ref for ref in job.artefacts}
            if job.kind == fuse.KIND.name and files.get(MESH) == meshes[-1]:
                return _read(step.title, job, files)
    raise DataError("no recorded job made the ground truth's mesh", where=summary.run_id)


def _read(step: str, job: JobState, files: Mapping[str, ArtefactRef]) -> RecordedFusion:
    spacing_m = float(job.arguments["spacing_m"])
    return RecordedFusion(step, fuse.KIND.read_answer(job.result), job.measures, spacing_m, files)


@lru_cache(maxsize=16)
def control_centres(scan: tuple[Point, ...], control: tuple[Point, ...]) -> tuple[Point, ...]:
    """Return centres that only the control scan shows, in the frame of the scan."""
    if not scan or not control:
        return ()
    from service.compute.surfaces.constellations import match_constellations  # noqa: PLC0415 - loads scipy

    a, b = np.array(scan), np.array(control)
    try:
        found = match_constellations(a, b)
    except ComputeError:
        return ()
    pairs = np.array(found.pairs)
    T_a_b, _ = align_points(a[pairs[:, 0]], b[pairs[:, 1]])
    extra: Array = apply(T_a_b, b[list(found.missing_b)]) if found.missing_b else np.zeros((0, 3))
    return tuple((float(x), float(y), float(z)) for x, y, z in extra)
