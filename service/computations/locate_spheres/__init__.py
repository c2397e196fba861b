"""Job kind `locate_spheres`: finds the spheres of a mesh, and how they moved since an earlier measurement."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, Matrix, Point, SpheresFound


class Arguments(JobRecord):
    """The mesh, and the number of spheres expected in it; `reference_m` are the spheres of an earlier mesh."""

    mesh: Hash
    radius_m: float
    expected: int
    reference_m: tuple[Point, ...] | None = None
    reference_covariances_m2: tuple[Matrix, ...] | None = None


KIND = JobKind(
    name="locate_spheres",
    arguments=Arguments,
    answer=SpheresFound,
    compute="service.computations.locate_spheres.compute:locate_spheres",
    words="spheres in the mesh",
    order=21,
    version=3,  # also gives the radius of the spheres, and the scale between two meshes
    demand=lambda _: Demand(memory_mb=1000, limit_s=3600),
)
