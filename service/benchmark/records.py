"""The stored result of a run of the benchmark: one record for each method and scenario, as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from service.core.errors import DataError
from service.core.records.base import Record

Scenario = Literal["dense", "sparse"]
RESULT = "result.json"
SCENARIOS: tuple[Scenario, ...] = ("dense", "sparse")


class Machine(Record):
    """The machine on which a method ran."""

    processor: str
    cores: int
    memory_gb: float
    gpu: str  # "" where no NVIDIA driver answers


class ComputingEffort(Record):
    """Time and memory that the commands of a method took.

    Attributes:
        wall_s: seconds on the clock.
        cpu_s: processor seconds of all processes.
        peak_memory_mb: largest main memory of any one process, MB.
    """

    wall_s: float
    cpu_s: float
    peak_memory_mb: float


class Score(Record):
    """A mesh compared with the truth: the paper's Chamfer distance and what belongs to it.

    Attributes:
        chamfer_mm: mean of accuracy and completeness.
        accuracy_mm, completeness_mm: mean distances from mesh to truth, and from truth to mesh.
        floor_mm: the `chamfer_mm` that sampling alone would give if both were equal.
        spacing_mm: distance between the samples.
        f_score_05, f_score_10: F-scores at 0.5 mm and 1 mm.
        normal_consistency: mean cosine between the normals, averaged over both directions.
        outside_percent: share of the mesh's area that was cut off because it is outside the box of the truth.
        excluded_percent: share of the samples farther than 20 mm, which are in no mean.
        seen_percent: share of the truth within 1 mm of the mesh.
    """

    chamfer_mm: float
    accuracy_mm: float
    completeness_mm: float
    floor_mm: float
    spacing_mm: float
    f_score_05: float
    f_score_10: float
    normal_consistency: float
    outside_percent: float
    excluded_percent: float
    seen_percent: float


class BenchmarkResult(Record):
    """The result of one method in one scenario.

    Attributes:
        method: its name.
        scenario: the split of the data set that the method was given.
        dataset_sha256: SHA-256 of the data set's list of checksums.
        simulated: the data set was made by a simulated rig.
        views: number of images.
        width, height: size of the first image in pixels.
        commands: the commands that were run; for a mesh made elsewhere, those that should have been.
        elsewhere: the mesh was made elsewhere.
        effort: None if the mesh was made elsewhere.
        mesh_sha256: SHA-256 of the method's own mesh file; "" if it made none.
        faces: number of faces of that mesh.
        score: None if the method made no mesh.
        failure: the reason why there is no mesh.
        machine: the machine on which it ran and was scored.
        finished_utc: time of its end, UTC.
    """

    method: str
    scenario: Scenario
    dataset_sha256: str
    simulated: bool
    views: int
    width: int
    height: int
    commands: tuple[tuple[str, ...], ...]
    elsewhere: bool
    effort: ComputingEffort | None
    mesh_sha256: str
    faces: int
    score: Score | None
    failure: str
    machine: Machine
    finished_utc: str


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
