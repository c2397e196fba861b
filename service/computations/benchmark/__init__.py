"""Job kind `benchmark`: runs a method of reconstruction on the run's data set, and compares its mesh with the truth.

The computation stands upon the data set and the methods, which know the other kinds by their declarations: it is the
one that imports upper rooms (decision 30). Its results are stored as JSON, one file for each method and scenario.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash
from service.core.errors import DataError
from service.core.units import megabytes

Scenario = Literal["dense", "sparse"]
# The kinds of its files: the mesh of the method, that mesh as it was scored, its heat maps; or what was printed.
MESH, SCORED_MESH, HEAT_MAPS, PRINTED = (
    "benchmark_mesh",
    "benchmark_scored_mesh",
    "benchmark_heat_maps",
    "benchmark_output",
)
_WORKED_PX = 1920 * 1280  # per image, to which the method `stereo` reduces larger ones


class Arguments(JobRecord):
    """The method to run, and the state of the record that its data set is made from.

    Attributes:
        run: the run.
        upto_seq, head_sha256: number and hash of the last event that counts; the run may go on being corrected.
        method: name of the method.
        scenario: the split of the data set that it gets.
        width: width of the images in pixels; 0: that of the photographs.
        spacing_m: the spacing to which both meshes are sampled.
        views: number of registered images that it gets; those of further cameras come on top.
        size_px: width and height of such an image.
    """

    run: str
    upto_seq: int
    head_sha256: Hash
    method: str
    scenario: Scenario
    width: int
    spacing_m: float
    views: int
    size_px: tuple[int, int]


class Machine(JobRecord):
    """The machine on which a method ran."""

    processor: str
    cores: int
    memory_gb: float
    gpu: str  # "" where no NVIDIA driver answers


class ComputingEffort(JobRecord):
    """Time and memory that the commands of a method took.

    Attributes:
        wall_s: seconds on the clock.
        cpu_s: processor seconds of all processes.
        peak_memory_mb: largest main memory of any one process, MB.
    """

    wall_s: float
    cpu_s: float
    peak_memory_mb: float


class Score(JobRecord):
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


class BenchmarkResult(JobRecord):
    """The result of one method in one scenario.

    Attributes:
        method: its name.
        scenario: the split of the data set that the method was given.
        dataset_sha256: SHA-256 of the data set's list of checksums; for a job, of what its data set is made from.
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
        version: the method's version, as it says itself; "" if it does not.
        random: the method makes another mesh each time.
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
    version: str = ""
    random: bool = False


def _demand(arguments: Arguments) -> Demand:
    """Measured for the method `stereo` (bench/results/reconstruction-*); the rest is the pixels that methods hold."""
    width, height = arguments.size_px
    images_mb = megabytes(width * height) * arguments.views
    worked_mb = megabytes(min(width * height, _WORKED_PX))  # a byte a pixel
    return Demand(1500 + (720 + 56 * arguments.views) * worked_mb + 5 * images_mb, limit_s=86400, alone=True)


def _unrepeatable(answer: BenchmarkResult) -> str:
    if answer.random:
        return f"{answer.method} makes another mesh each time, so that there is nothing to compare"
    return "" if answer.score is not None else f"{answer.method} made no mesh, so that there is nothing to compare"


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


KIND = JobKind(
    name="benchmark",
    arguments=Arguments,
    answer=BenchmarkResult,
    compute="service.computations.benchmark.compute:benchmark",
    words="benchmark of reconstruction",
    order=90,
    replayed=False,
    aside=True,
    demand=_demand,
    needs=lambda arguments: arguments.method,
    lacking="service.benchmark.methods:lacking_here",
    circumstances=("commands", "effort", "failure", "finished_utc", "machine"),
    unrepeatable=_unrepeatable,
)
