"""Job kind `evaluate`: the paper's errors on the control spheres, and the error budget, for every registration."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import PosedPhotograph, SpheresFound
from service.computations.registration import Registration
from service.compute.scene import ControlSphere
from service.machine.resources import IMAGE_MB, processes_for


class Arguments(JobRecord):
    """Control captures, registrations by name, and the spheres as scanner and CT measured them; their colour."""

    images: tuple[PosedPhotograph, ...]
    registrations: dict[str, Registration]
    scan: SpheresFound
    control_scan: SpheresFound | None = None
    ct: SpheresFound | None = None
    radius_m: float
    colour: str | None = None


class Row(JobRecord):
    """One registration in the paper's table.

    Attributes:
        poses: the registration's name.
        source: the source of its camera poses.
        resolution: the images' resolution.
        images: number of control images with a pose.
        predicted_error_mm: the error by the error budget.
        control_error_mm: the error of the control spheres as located in the images; None without any.
        control_normalised_chi2: the χ² of that error against its predicted covariance, normalised.
        mean_radial_error_mm: the mean radial error as the paper defines it.
        mean_reprojection_error_px: the mean reprojection error as the paper defines it.
        evaluated_on: the spheres that were compared: `control spheres`, or `each sphere left out`.
        control_outlines: number of outlines compared.
        control_spheres: each control sphere by itself; empty in jobs of earlier versions.
        late: a text that says when the row arrived, if that was after the evaluation.
    """

    poses: str
    source: str = ""
    resolution: str = ""
    images: int | None = None
    predicted_error_mm: float | None = None
    control_error_mm: float | None = None
    control_normalised_chi2: float | None = None
    mean_radial_error_mm: float
    mean_reprojection_error_px: float | None = None
    evaluated_on: str = "control spheres"
    control_outlines: int = 0
    control_spheres: tuple[ControlSphere, ...] = ()
    late: str = ""

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences on what is wrong with control spheres."""
        return tuple(sphere.finding for sphere in self.control_spheres if sphere.finding)


def best_row(rows: Sequence[Row]) -> Row:
    """Return the row of an evaluation's table with the smallest error on control spheres; of equal ones the first."""
    return min(rows, key=_error_mm)


def _error_mm(row: Row) -> float:
    return row.mean_radial_error_mm


class Contribution(JobRecord):
    """One source of error (1σ, 3D); the sum includes it if it is `counted`."""

    name: str
    sigma_mm: float
    how: str
    counted: bool


class Observation(JobRecord):
    """An independent measurement of `n` spheres, with the error that the budget predicts for it."""

    name: str
    observed_mm: float
    predicted_mm: float
    normalised_chi2: float
    n: int
    how: str
    verdict: str


class ErrorBudget(JobRecord):
    """The sources of a registration's error, compared with independent measurements."""

    contributions: tuple[Contribution, ...] = ()
    total_mm: float | None = None
    observations: tuple[Observation, ...] = ()


class Answer(JobRecord):
    """The table, and the error budget of each registration."""

    table: tuple[Row, ...]
    budgets: dict[str, ErrorBudget] = Field(default_factory=dict[str, ErrorBudget])


KIND = JobKind(
    name="evaluate",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.evaluate.compute:evaluate",
    words="evaluation",
    version=3,
    order=70,
    demand=lambda arguments: Demand(
        memory_mb=600 + IMAGE_MB * processes_for(len(arguments.images), IMAGE_MB),
        limit_s=3600 + 120 * len(arguments.images),
    ),
)
