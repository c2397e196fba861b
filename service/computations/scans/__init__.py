"""Job kinds of scans and CT: a mesh of the CT, one scan of several partial ones, and the spheres in a mesh."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, Matrix, Point, SpheresFound


class CtSurfaceArguments(JobRecord):
    """The decoded volume: `hounsfield` is a NumPy array, `T_ct_voxel` maps its indices to metres.

    With `labels`, an array of the same shape, the surface is that of the segmented voxels, not at `threshold_hu`.
    With `measure_cut`, the measures say how much the first and the last slice cut.
    """

    radius_m: float
    expected: int
    slices: tuple[Hash, ...] = ()
    hounsfield: Hash
    T_ct_voxel: Matrix
    threshold_hu: float
    labels: Hash | None = None
    measure_cut: bool = False  # jobs of earlier versions did not


CT_SURFACE = JobKind(
    name="ct_surface",
    arguments=CtSurfaceArguments,
    answer=SpheresFound,
    compute="service.computations.scans.compute:ct_surface",
    words="CT surface",
    order=20,
    version=3,  # also gives the radius of the spheres
    demand=lambda _: Demand(memory_mb=1500, limit_s=7200),
)


class LocateSpheresArguments(JobRecord):
    """The mesh, and the number of spheres expected in it; `reference_m` are the spheres of an earlier mesh."""

    mesh: Hash
    radius_m: float
    expected: int
    reference_m: tuple[Point, ...] | None = None
    reference_covariances_m2: tuple[Matrix, ...] | None = None


LOCATE_SPHERES = JobKind(
    name="locate_spheres",
    arguments=LocateSpheresArguments,
    answer=SpheresFound,
    compute="service.computations.scans.compute:locate_spheres",
    words="spheres in the mesh",
    order=21,
    version=3,  # also gives the radius of the spheres, and the scale between two meshes
    demand=lambda _: Demand(memory_mb=1000, limit_s=3600),
)


class MergeScansArguments(JobRecord):
    """The meshes of the parts, and what `locate_spheres` needs of the merged one."""

    meshes: tuple[Hash, ...]
    radius_m: float
    expected: int
    reference_m: tuple[Point, ...] | None = None
    reference_covariances_m2: tuple[Matrix, ...] | None = None


class MergeScansAnswer(SpheresFound):
    """The spheres of the merged mesh, which is in the frame of the first part."""

    T_mesh_part: tuple[Matrix, ...]  # the pose of each part


MERGE_SCANS = JobKind(
    name="merge_scans",
    arguments=MergeScansArguments,
    answer=MergeScansAnswer,
    compute="service.computations.scans.compute:merge_scans",
    words="merging of the scan's parts",
    order=23,
    demand=lambda arguments: Demand(memory_mb=500 + 200 * len(arguments.meshes), limit_s=7200),
)

KINDS = (CT_SURFACE, LOCATE_SPHERES, MERGE_SCANS)
