"""Job kind `merge_scans`: one mesh of several scans that share spheres, and the spheres in it."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, Matrix, Point, SpheresFound


class Arguments(JobRecord):
    """The meshes of the parts, and what `locate_spheres` needs of the merged one."""

    meshes: tuple[Hash, ...]
    radius_m: float
    expected: int
    reference_m: tuple[Point, ...] | None = None
    reference_covariances_m2: tuple[Matrix, ...] | None = None


class Answer(SpheresFound):
    """The spheres of the merged mesh, which is in the frame of the first part."""

    T_mesh_part: tuple[Matrix, ...]  # the pose of each part


KIND = JobKind(
    name="merge_scans",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.merge_scans.compute:merge_scans",
    words="merging of the scan's parts",
    order=23,
    demand=lambda arguments: Demand(memory_mb=500 + 200 * len(arguments.meshes), limit_s=7200),
)
