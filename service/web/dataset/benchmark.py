"""The benchmark of reconstruction on a run's data set, where DIR/benchmark holds results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from service.benchmark.records import SCENARIOS, BenchmarkResult, read_results
from service.core.errors import DataError
from service.core.records.events import Event, EvidenceExported

FOLDER = "benchmark"


@dataclass(frozen=True, slots=True)
class Benchmark:
    """The results that belong to a run: those on one of the data sets that it has exported.

    Attributes:
        results: by method, dense before sparse.
        best: smallest Chamfer distance of each scenario, mm.
        problem: why they cannot be read; "".
    """

    results: tuple[BenchmarkResult, ...]
    best: tuple[tuple[str, float], ...]
    problem: str = ""


def benchmark_of(data: Path, events: Sequence[Event]) -> Benchmark:
    """The results in DIR/benchmark whose data set has the list of checksums that the run has recorded."""
    exported = {e.payload.sha256 for e in events if isinstance(e.payload, EvidenceExported)}
    try:
        found = read_results(data / FOLDER) if exported else ()
    except (DataError, OSError) as error:
        return Benchmark((), (), str(error))
    results = sorted(
        (result for result in found if result.dataset_sha256 in exported),
        key=lambda result: (result.method, SCENARIOS.index(result.scenario)),
    )
    scores = {
        scenario: [r.score.chamfer_mm for r in results if r.scenario == scenario and r.score is not None]
        for scenario in SCENARIOS
    }
    return Benchmark(tuple(results), tuple((name, min(values)) for name, values in scores.items() if values))
