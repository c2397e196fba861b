"""Job kind `evaluate`: the paper's errors on the control spheres, and the error budget, for every registration."""

from __future__ import annotations

from pydantic import Field

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import Photograph, SpheresFound
from service.jobs.registration.register import Registration


class Arguments(JobRecord):
    """The control captures, the registrations by name, and the spheres as scanner and CT measured them."""

    images: tuple[Photograph, ...]
    registrations: dict[str, Registration]
    scan: SpheresFound
    control_scan: SpheresFound | None = None
    ct: SpheresFound | None = None
    radius_m: float


class Row(JobRecord):
    """One registration in the paper's table.

    Attributes:
        poses: name of the registration.
        source: of its camera poses.
        resolution: of the images.
        images: of the control captures that it has a pose for.
        predicted_error_mm: by the error budget.
        control_error_mm: of the control spheres located in the images; None without any.
        control_normalised_chi2: of that.
        mean_radial_error_mm: the paper's.
        mean_reprojection_error_px: the paper's.
        evaluated_on: control spheres, or each sphere left out.
        control_outlines: that were compared.
        late: when it came, in words, of a row that was not there when the evaluation was made.
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
    late: str = ""


class Contribution(JobRecord):
    """One source of error (1σ, 3D); `counted` ones are in the sum."""

    name: str
    sigma_mm: float
    how: str
    counted: bool


class Observation(JobRecord):
    """An independent measurement of `n` spheres, and what the budget predicts for it."""

    name: str
    observed_mm: float
    predicted_mm: float
    normalised_chi2: float
    n: int
    how: str
    verdict: str


class ErrorBudget(JobRecord):
    """Where the error of a registration comes from, and what independent measurements say of it."""

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
    compute="service.worker.registration.evaluate:evaluate",
    words="evaluation",
    order=70,
)
