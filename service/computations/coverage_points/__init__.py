"""Job kind `coverage_points`: points of the specimen's CT surface that the images should see."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord, NoAnswer
from service.computations.records import Hash, Limits, Point


class Arguments(JobRecord):
    """The CT's mesh and the spheres in it."""

    mesh: Hash
    spheres_m: tuple[Point, ...]
    radius_m: float
    limits: Limits


KIND = JobKind(
    name="coverage_points",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.computations.coverage_points.compute:coverage_points",
    words="the specimen's surface",
    order=30,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=1400, limit_s=1800),
)
