"""A run on a simulated rig that has ended, read from its data folder and compared with the simulator's truth."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from service.cli.demo import true_errors_mm
from service.dataset.summary import RunSummary, summarise
from service.run_start import recorded_run
from service.store.store import Store


@dataclass(frozen=True)
class EndedRun:
    """The run and its true errors in mm by the source of the poses; its store stays open."""

    data: Path
    summary: RunSummary
    true_mm: dict[str, float]


@contextmanager
def ended_run(data: Path, truth: Path) -> Generator[EndedRun]:
    """The latest run of a data folder; `truth` is the simulator's file."""
    with Store.open(data, create=False) as store:
        run_id = store.find_run("latest")
        summary = summarise(store, run_id, recorded_run(store, run_id)[0])
        yield EndedRun(data, summary, true_errors_mm(summary, truth))
