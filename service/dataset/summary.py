"""A finished or stopped run, as the report and the data set need it, read from the evidence alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

import numpy as np

from service.core.geometry import Array
from service.core.protocol.models import Protocol
from service.core.records.events import ArtefactRef, Event, JobFinished, RunStarted, View
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.dataset.registrations import (
    better_later,
    budgets,
    evaluated,
    last_result,
    own_registration,
    registrations,
)
from service.jobs.records import Point, SpheresFound
from service.jobs.registration.evaluate import ErrorBudget, Row
from service.jobs.registration.register import Registration
from service.store.store import Store


class ArtefactReader(Interface):
    """Finds the files of the evidence."""

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """Path of an artefact's read-only file. Raises IntegrityError if missing or, with `verify`, if altered."""
        ...


@dataclass(frozen=True, slots=True)
class RunSummary:
    """The record of one run."""

    run_id: str
    protocol: Protocol
    root: RunStarted
    state: RunState
    events: Sequence[Event]
    store: ArtefactReader

    def registrations(self) -> Mapping[str, Registration]:
        """Registrations by name, including those that arrived after the step's decision."""
        return registrations(self.protocol, self.state)

    def table(self) -> Sequence[Row]:
        """The paper's table: control sphere errors for each source of poses, including late arrivals."""
        return evaluated(self.protocol, self.state)

    def budgets(self) -> Mapping[str, ErrorBudget]:
        """The error budget of each evaluated registration."""
        return budgets(self.protocol, self.state)

    def best(self) -> str | None:
        """Name of the run's own registration: the best that the evaluation step judged (registrations.py)."""
        return own_registration(self.protocol, self.state)

    def better_later(self) -> Row | None:
        """The row of a registration that arrived after the evaluation and beats the run's own, if any."""
        return better_later(self.protocol, self.state)

    def captures(self) -> Iterable[View]:
        """Every valid capture in order, including those for calibration."""
        seqs = sorted(seq for step in self.state.steps.values() for seq in step.captured.values())
        payloads = (self.events[seq - 1].payload for seq in seqs)
        return (payload for payload in payloads if isinstance(payload, View))

    def artefacts(self, kind: str) -> tuple[ArtefactRef, ...]:
        """Artefacts of a kind in the results of the run's valid steps."""
        refs = (ref for s in self.protocol.steps for ref in self.state.steps[s.id].artefacts)
        return tuple(ref for ref in refs if ref.kind == kind)

    def jobs(self) -> Sequence[JobFinished]:
        """All finished jobs."""
        return [event.payload for event in self.events if isinstance(event.payload, JobFinished)]

    def scan_spheres_m(self) -> tuple[Point, ...]:
        """Sphere centres of the registered scan in its own frame; empty before the scan was imported."""
        result = last_result(self.protocol, self.state, "scan_import", SpheresFound)
        return () if result is None else result.spheres_m

    def scan_mesh(self) -> tuple[Array, Any]:
        """Vertices (V, 3) in metres and faces (F, 3) of the registered scan that was imported last."""
        ref = self.artefacts("scan_mesh")[-1]
        with np.load(self.store.artefact_path(ref.sha256), allow_pickle=False) as mesh:
            return mesh["vertices_m"], mesh["faces"]


def summarise(store: Store, run_id: str, protocol: Protocol) -> RunSummary:
    """Read a run and fold its events."""
    events = store.events(run_id)
    root = events[0].payload
    assert isinstance(root, RunStarted)  # service.run_start has checked it
    return RunSummary(run_id, protocol, root, fold(protocol, events), events, store)
