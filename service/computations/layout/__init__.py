"""Job kind `layout`: from photographs of the placed spheres, whether they are distinguishable, and what to move."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, JudgedLayout, Point


class LayoutPhotograph(JobRecord):
    """A photograph taken with an uncalibrated lens."""

    sha256: Hash
    focal_mm: float


class Arguments(JobRecord):
    """The photographs, and the number and radius of the spheres."""

    images: tuple[LayoutPhotograph, ...]
    sensor_width_mm: float
    radius_m: float
    expected: int | None = None
    control: int = 0


class SphereMove(JobRecord):
    """A move of a sphere, as text and between places in the photograph, as fractions of its width and height."""

    model_config = ConfigDict(serialize_by_alias=True, validate_by_name=True, validate_by_alias=True)

    words: str
    old_place: tuple[float, float] = Field(alias="from")
    new_place: tuple[float, float] = Field(alias="to")
    higher_mm: float


class SearchedPhotograph(JobRecord):
    """A photograph of the spheres: whether it is used, and the centre of each sphere's outline in pixels."""

    used: bool
    spheres: dict[str, tuple[float, float]]


class LayoutDetails(JudgedLayout):
    """The judged layout, its photographs, and the moves that would resolve its near-symmetries."""

    chi2: float | None = None  # reduced χ² of the adjustment of the photographs
    photographs: tuple[SearchedPhotograph, ...] = ()
    moves: tuple[SphereMove, ...] = ()


class Answer(JobRecord):
    """The spheres in the frame of the photograph that shows most of them, metres."""

    spheres_m: tuple[Point, ...]
    details: LayoutDetails


KIND = JobKind(
    name="layout",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.layout.compute:layout",
    words="layout of the spheres",
    version=3,  # takes no outline of a known sphere for a sphere of its own
    order=22,
    demand=lambda arguments: Demand(memory_mb=1200, limit_s=1800 + 300 * len(arguments.images)),
)
