"""The stored results of the benchmark: one record for each method and scenario, as JSON."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from service.computations.benchmark import BenchmarkResult, Scenario
from service.core.errors import DataError

RESULT = "result.json"
SCENARIOS: tuple[Scenario, ...] = ("dense", "sparse")


def read_results(out: Path) -> tuple[BenchmarkResult, ...]:
    """Read all results in a folder, by name of their folders.

    Raises:
        DataError: a file is not a result.
    """
    results: list[BenchmarkResult] = []
    for path in sorted(out.glob(f"*/{RESULT}")):
        try:
            results.append(BenchmarkResult.model_validate_json(path.read_bytes()))
        except ValidationError as error:
            raise DataError("this is not a result of the benchmark", where=str(path), remedy="Remove it") from error
    return tuple(results)
