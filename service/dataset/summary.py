"""A finished (or stopped) run as the report and the data set need it, read from the evidence alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

import numpy as np

from service.core.fold import fold
from service.core.geometry import Array
from service.core.model import ArtefactRef, Event, JobFinished, RunStarted, View
from service.core.protocol import Protocol
from service.core.run_state import RunState
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
        results = [self.state.steps[s.id].result for s in self.protocol.steps if s.kind == kind]
        return next((result for result in reversed(results) if result), {})

    def table(self) -> Sequence[Mapping[str, Any]]:
        """The paper's table: errors on the control spheres for each source of poses."""
        return self.result("evaluation").get("table", ())

    def best(self) -> str | None:
        """The source of poses with the smallest mean radial error."""
        rows = self.table()
        return min(rows, key=lambda row: row["mean_radial_error_mm"])["poses"] if rows else None

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
    assert isinstance(root, RunStarted)  # service.runs has read it the same way
    return RunSummary(run_id, protocol, root, fold(protocol, events), events, store)
