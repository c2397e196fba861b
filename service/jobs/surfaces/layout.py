"""Job kind `layout`: photographs of the placed spheres tell whether they can be told apart, and what to move."""

from __future__ import annotations

from typing import Any

from service.jobs.kind import JobKind, JobRecord
from service.jobs.records import Hash, Point


class LayoutPhotograph(JobRecord):
    """A photograph of a lens that is not calibrated yet."""

    sha256: Hash
    focal_mm: float


class Arguments(JobRecord):
    """The photographs, and how many spheres of which radius stand there."""

    images: tuple[LayoutPhotograph, ...]
    sensor_width_mm: float
    radius_m: float
    expected: int | None = None
    control: int = 0


class LayoutDetails(JobRecord):
    """Near-symmetries (compute/registration/layout.py), and what to do about them."""

    problems: tuple[str, ...] = ()
    moves: tuple[dict[str, Any], ...] = ()


class Answer(JobRecord):
    """The spheres in the frame of the photograph with most of them, metres."""

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
