"""Job kind `layout`: from photographs of the placed spheres, whether they are distinguishable, and what to move."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import Hash, Point


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
    """A move of a sphere, in words and between places in the photograph, as fractions of its width and height."""

    words: str
    old_place: tuple[float, float] = Field(validation_alias="from")
    new_place: tuple[float, float] = Field(validation_alias="to")
    higher_mm: float


class LayoutDetails(JobRecord):
    """Near-symmetries (service/compute/layout/ambiguity.py), and the moves that would resolve them."""

    problems: tuple[str, ...] = ()
    moves: tuple[dict[str, Any], ...] = ()  # SphereMove reads them; its fields cannot be named as they are recorded


class Answer(JobRecord):
    """The spheres in the frame of the photograph that shows most of them, metres."""

    spheres_m: tuple[Point, ...]
    details: LayoutDetails


KIND = JobKind(
    name="layout",
    arguments=Arguments,
    answer=Answer,
    compute="service.worker.surfaces.layout:layout",
    words="layout of the spheres",
    order=22,
)
