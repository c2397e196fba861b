"""A finished (or stopped) run as the report and the data set need it, read from the evidence alone."""

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
from service.core.results.registrations import (
    better_later,
    budgets,
    evaluated,
    last_result,
    own_registration,
    registrations,
)
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.store.store import Store


class ArtefactReader(Interface):
    """Where the files of the evidence are."""

    def artefact_path(self, sha256: str, *, verify: bool = False) -> Path:
        """The read-only file of an artefact. Raises IntegrityError when missing or, with `verify`, altered."""
        ...


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What is recorded of a run."""

    run_id: str
    protocol: Protocol
    root: RunStarted
    state: RunState
    events: Sequence[Event]
    store: ArtefactReader

    def result(self, kind: str) -> Mapping[str, Any]:
        """The Result of the last passed step of a kind; empty if there is none."""
        return last_result(self.protocol, self.state, kind)

    def registrations(self) -> Mapping[str, Mapping[str, Any]]:
        """Every registration by its name, those that arrived after the step's decision included."""
        return registrations(self.protocol, self.state)

    def table(self) -> Sequence[Mapping[str, Any]]:
        """The paper's table: errors on the control spheres for each source of poses, whenever it arrived."""
        return evaluated(self.protocol, self.state)

    def budgets(self) -> Mapping[str, Mapping[str, Any]]:
        """The error budget of each registration that was evaluated."""
        return budgets(self.protocol, self.state)

    def best(self) -> str | None:
        """The run's own registration: the best of those that the evaluation step judged; see core/registered.py."""
        return own_registration(self.protocol, self.state)

    def better_later(self) -> Mapping[str, Any] | None:
        """The row of a registration that arrived after the evaluation and is better than the run's own."""
        return better_later(self.protocol, self.state)

    def captures(self) -> Iterable[View]:
        """Every valid capture, in order, calibration included."""
        seqs = sorted(seq for step in self.state.steps.values() for seq in step.captured.values())
        payloads = (self.events[seq - 1].payload for seq in seqs)
        return (payload for payload in payloads if isinstance(payload, View))

    def artefacts(self, kind: str) -> tuple[ArtefactRef, ...]:
        """Artefacts of a kind among the results of the run's valid steps."""
        refs = (ref for s in self.protocol.steps for ref in self.state.steps[s.id].artefacts)
        return tuple(ref for ref in refs if ref.kind == kind)

    def jobs(self) -> Sequence[JobFinished]:
        """Everything that workers computed."""
        return [event.payload for event in self.events if isinstance(event.payload, JobFinished)]

    def scan_mesh(self) -> tuple[Array, Any]:
        """Vertices (V, 3) in metres and faces (F, 3) of the registered scan; the last one imported."""
        ref = self.artefacts("scan_mesh")[-1]
        with np.load(self.store.artefact_path(ref.sha256), allow_pickle=False) as mesh:
            return mesh["vertices_m"], mesh["faces"]


def summarise(store: Store, run_id: str, protocol: Protocol) -> RunSummary:
    """Read a run."""
    events = store.events(run_id)
    root = events[0].payload
    assert isinstance(root, RunStarted)  # service.run_start has read it the same way
    return RunSummary(run_id, protocol, root, fold(protocol, events), events, store)
